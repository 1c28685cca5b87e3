"""A kept cloud's folder, its certificates, and LISTEN=."""

from __future__ import annotations

import fcntl
import os
import re
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from iort_station import kept
from iort_station.errors import StationError
from iort_station.kept import owner
from iort_station.page.background import BackgroundServer
from local.deployment import ROOT
from local.network.certificates import Authority, ServerCertificate
from local.network.servers import Listen
from local.processes import Child, LocalError
from local.state import USUAL_PORTS, StateFolder
from local.up import service
from local.up.commands import stop
from testkit.waiting import GUARD_S


@pytest.fixture
def state(tmp_path):
    with ExitStack() as stack:
        state = StateFolder(tmp_path / "cloud", kept=True)
        state.take(stack)
        yield state


def test_a_kept_folder_keeps_its_ports_and_a_second_cloud_is_refused(state):
    port = state.port("mqtt", "127.0.0.1")
    state.remember_port("mqtt", port)
    again = StateFolder(state.path, kept=True)
    assert again.port("mqtt", "127.0.0.1") == port
    with ExitStack() as stack, pytest.raises(LocalError, match=r"already running in .*`make down`"):
        again.take(stack)
    with (
        socket.create_server(("127.0.0.1", port)),
        pytest.raises(LocalError, match=r"is in use .*'sport = :.*`make down .*settings\.json, .*car\.yaml"),
    ):
        again.port("mqtt", "127.0.0.1")


def test_down_of_another_users_cloud_says_so(tmp_path, monkeypatch):
    def refuses(_folder):
        raise PermissionError(13, "Permission denied", "cloud.lock")

    monkeypatch.setattr("local.up.commands.owner", refuses)
    with pytest.raises(LocalError, match="is another user's, who must stop its cloud"):
        stop(tmp_path)


def test_a_second_cloud_leaves_the_usual_ports_to_the_first(tmp_path):
    state = StateFolder(tmp_path, kept=True, any_ports=True)
    assert not {state.port(name, "127.0.0.1") for name in USUAL_PORTS} & set(USUAL_PORTS.values())


def test_a_folder_of_a_newer_version_is_refused_with_a_reason(tmp_path):
    (tmp_path / "cloud").mkdir()
    (tmp_path / "cloud" / "VERSION").write_text("2")
    with (
        ExitStack() as stack,
        pytest.raises(LocalError, match=r"must have version 1 or older, got 2: a newer iort wrote it"),
    ):
        StateFolder(tmp_path / "cloud", kept=True).take(stack)


def test_a_folder_with_somebodys_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with (
        ExitStack() as stack,
        pytest.raises(LocalError, match=r"STATE must be an empty folder .*thesis\.tex"),
    ):
        StateFolder(tmp_path, kept=True).take(stack)
    assert (tmp_path / "thesis.tex").exists()


def test_down_knows_whether_a_cloud_is_up(tmp_path):
    assert owner(tmp_path / "nowhere") is None
    assert not stop(tmp_path / "nowhere")
    with ExitStack() as stack:
        StateFolder(tmp_path / "cloud", kept=True).take(stack)
        assert owner(tmp_path / "cloud")
    assert owner(tmp_path / "cloud") is None


def test_a_link_to_the_folder_is_the_same_cloud(state):
    link = state.path.with_name("link")
    link.symlink_to(state.path)
    with ExitStack() as stack, pytest.raises(LocalError, match="already running"):
        StateFolder(link, kept=True).take(stack)


def test_down_never_ends_a_process_that_only_has_the_number_of_an_earlier_cloud(tmp_path):
    stranger = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    with stranger, kept.lock_of(tmp_path / "cloud").open("a+") as lock:
        # As between the lock of a new cloud and its own number.
        lock.write(str(stranger.pid))
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert not stop(tmp_path / "cloud")
        stranger.communicate(b"\n")
    assert stranger.returncode == 0


def test_who_asks_for_the_owner_is_in_no_starts_way(tmp_path, monkeypatch):
    code = (
        "import sys; from contextlib import ExitStack; from pathlib import Path; "
        "from local.state import StateFolder\n"
        "with ExitStack() as stack:\n"
        "    StateFolder(Path(sys.argv[1]), kept=True).take(stack); print('up', flush=True); input()"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    cloud = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "cloud")], cwd=ROOT, **pipes)
    with cloud:
        assert cloud.stdout.readline() == b"up\n"
        monkeypatch.setattr(kept.fcntl, "flock", lambda *_: pytest.fail("it takes the lock"))
        assert owner(tmp_path / "cloud") == cloud.pid
        cloud.communicate(b"\n")
    assert owner(tmp_path / "cloud") is None


def test_nobody_else_can_lock_the_folder(state):
    assert kept.lock_of(state.path).stat().st_mode & 0o777 == 0o600


def test_a_folder_that_cannot_be_written_is_an_error_that_says_so(tmp_path):
    (tmp_path / "file").touch()
    with ExitStack() as stack, pytest.raises(LocalError, match="must be able to write"):
        StateFolder(tmp_path / "file" / "cloud", kept=True).take(stack)


def test_a_port_is_free_on_each_of_its_addresses(state):
    with socket.create_server(("127.0.0.2", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LocalError, match="is in use"):
            state.port("mqtt", "127.0.0.1", "127.0.0.2", wanted=port)


@pytest.mark.parametrize(
    ("given", "possible"),
    [
        ("32768\t60999", {*range(20_000, 32_768), *range(61_000, 65_536)}),
        ("1024 60999", {*range(61_000, 65_536)}),
        ("1024 65535", {*range(1024, 65_536)}),
    ],
    ids=["usual", "above only", "none is left"],
)
def test_a_kept_port_is_none_that_the_system_gives_to_others(state, monkeypatch, given, possible):
    (state.path / "range").write_text(given)
    monkeypatch.setattr("local.state._EPHEMERAL", state.path / "range")
    assert state.port("gateway", "127.0.0.1") in possible


@pytest.mark.parametrize(
    "text", ["", "iort.lab", "0.0.0.0", "::", "192.0.2.1/24", "192.0.2.1,no name", "fe80::1%eth0"]
)
def test_listen_needs_an_address_to_name_in_a_bundle(text):
    with pytest.raises(LocalError, match=r"^LISTEN must .*got "):
        Listen.parse(text, "LISTEN")


def test_cars_are_told_a_name_if_there_is_one():
    assert Listen.parse("192.0.2.1", "LISTEN").host == "192.0.2.1"
    found = Listen.parse("192.0.2.1, 10.0.0.1,IoRT.lab,other", "LISTEN")
    assert (found.address, found.host) == ("192.0.2.1", "iort.lab")
    assert found.hosts == ("192.0.2.1", "10.0.0.1", "iort.lab", "other")
    assert (found.at(8444), found.at(443)) == ("iort.lab:8444", "iort.lab")
    assert Listen.parse("FD77:0::1", "LISTEN").at(8444) == "[fd77::1]:8444"
    with pytest.raises(LocalError, match=r"must be an address of this machine, got 192\.0\.2\.1"):
        found.check("LISTEN")


def test_a_kept_authority_renews_a_certificate_before_its_end_and_for_other_hosts(tmp_path):
    authority = Authority(tmp_path)
    day_s = 86_400.0

    def certificate(*hosts: str, authority: Authority = authority, lasts_s: float = 90 * day_s):
        return ServerCertificate(authority, tmp_path / "broker.pem", hosts, lasts_s, renewed_s=30 * day_s)

    assert certificate("192.0.2.1", lasts_s=29 * day_s).renew()
    # It ends within the thirty days.
    assert certificate("192.0.2.1").renew()
    assert certificate("192.0.2.1").ends_s() == pytest.approx(time.time() + 90 * day_s, abs=60)
    assert not certificate("192.0.2.1", authority=Authority(tmp_path)).renew()
    assert certificate("192.0.2.1", "iort.lab").renew()
    for kind in ("pem", "key"):
        (tmp_path / f"authority.{kind}").unlink()
    assert certificate("192.0.2.1", "iort.lab", authority=Authority(tmp_path)).renew()
    for secret in ("authority.key", "broker.pem"):
        assert (tmp_path / secret).stat().st_mode & 0o777 == 0o600


def test_up_json_is_read_as_it_was_written(tmp_path):
    with pytest.raises(StationError, match=r"no cloud is up in .*`make up`"):
        kept.Up.load(tmp_path)
    up = kept.Up(
        version=1,
        versions={"iort": "1"},
        started_s=1.0,
        pids={"up": 1, "emulator": 2},
        ports={"mqtt": 8883},
        listen=["192.0.2.1"],
        page=[],
        certificates=[kept.Certificate(name="broker", file="b.pem", hosts=["192.0.2.1"], ends_s=2.0)],
        ledger="ledger.db",
        power_cut=True,
    )
    (tmp_path / kept.UP).write_text(up.text())
    assert kept.Up.load(tmp_path) == up
    (tmp_path / kept.UP).write_text("{}")
    with pytest.raises(StationError, match=r"up\.json must describe a kept cloud"):
        kept.Up.load(tmp_path)


@pytest.mark.parametrize("of_machine", [True, False])
def test_the_unit_starts_this_checkout_with_the_options(of_machine):
    text = service.unit(["--state", "/srv/100% iort/$x"], of_machine=of_machine)
    assert f"WorkingDirectory={ROOT}\n" in text
    assert '-m" "local.up.run" "--state" "/srv/100%% iort/$$x"\n' in text
    assert "Type=notify\n" in text
    assert "Restart=on-failure\n" in text
    assert re.search(r"WantedBy=(multi-user|default)\.target\n", text)[1] == (
        "multi-user" if of_machine else "default"
    )
    assert Path(re.search(r'ExecStart="([^"]+)"', text)[1]).exists()


@pytest.mark.parametrize("may_linger", [True, False])
def test_who_has_a_service_of_its_own_is_told_if_it_does_not_outlast_the_login(
    tmp_path, monkeypatch, capsys, may_linger
):
    called = []

    def run(command, **_given):
        called.append(command)
        refused = command[0] == "loginctl" and not may_linger
        return subprocess.CompletedProcess(command, int(refused), "", "")

    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setattr(service.subprocess, "run", run)
    service._install("unit", of_machine=False)
    told = capsys.readouterr().out
    assert (tmp_path / "systemd" / "user" / service.NAME).read_text() == "unit"
    assert ["loginctl", "enable-linger"] in [one[:2] for one in called]
    assert ("started with the machine" in told) == may_linger
    assert ("After a reboot it starts when" in told and "sudo loginctl enable-linger" in told) != may_linger


def test_a_full_disk_shortens_a_log_all_the_same(tmp_path):
    log = tmp_path / "log"
    child = Child("child", ["true"], environment=os.environ, cwd=tmp_path, log=log)
    child.wait()
    log.write_bytes(b"x" * 100)
    # As little as a full disk can it be written.
    (tmp_path / "log.1").mkdir()
    child.shorten_log(50)
    assert log.read_bytes() == b""


def test_a_page_at_an_ipv6_address_needs_a_name_that_a_browsers_policy_can_have(tmp_path):
    up = [sys.executable, "-m", "local.up.run", "--state", str(tmp_path / "cloud"), "--page", "::1"]
    done = subprocess.run(up, cwd=ROOT, capture_output=True, text=True, timeout=GUARD_S, check=False)
    assert (done.returncode, done.stderr) == (
        1,
        "up: PAGE must have a name after an IPv6 address, such as PAGE=::1,iort.lab\n",
    )


def test_a_server_that_finds_its_port_taken_meanwhile_says_so(state):
    server = BackgroundServer("127.0.0.1", state.port("files", "127.0.0.1"))
    with (
        ExitStack() as stack,
        socket.create_server((server.host, server.port)),
        pytest.raises(LocalError, match=rf"port {server.port} \(files\) is in use .*: start again"),
    ):
        state.serve(stack, "files", server)
    # It has never been this cloud's, so that the next start takes another.
    assert "files" not in state.settings().ports
    with ExitStack() as stack:
        state.serve(stack, "files", server)
        assert state.settings().ports["files"] == server.port
