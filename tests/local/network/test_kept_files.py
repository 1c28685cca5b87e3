"""The files of a kept cloud, after somebody or something has damaged them: nothing is lost without a word."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import tempfile
import threading
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from argon2 import PasswordHasher

from iort_station.errors import StationError
from iort_station.page.password import Password
from local.network.certificates import Authority, ServerCertificate
from local.persistence import ledger
from local.processes import LocalError
from local.state import StateFolder
from local.up import commands, run

HOST = "127.0.0.1"
NOBODY = 65_534


def start(folder):
    """Read and make the files as a start does, without an emulator; what the cloud is known by."""
    with ExitStack() as stack:
        state = StateFolder(folder, kept=True)
        state.take(stack)
        for server in ("mqtt", "files"):
            state.remember_port(server, state.port(server, HOST))
        owner = [state.secret("owner.id", 8), state.secret("owner.key")]
        assert [len(one) for one in owner] == [16, 40]
        authority = Authority(folder)
        certificate = ServerCertificate(authority, folder / "broker.pem", (HOST,))
        certificate.renew()
        assert authority.signed(certificate._read())
        Password(folder, PasswordHasher(1, 8, 1)).make()
        with closing(ledger.Ledger(folder / "ledger.db")) as kept:
            kept.define("CREATE TABLE IF NOT EXISTS kept (name)")
            with kept.write() as connection:
                connection.execute("INSERT INTO kept VALUES (?)", ("x" * 9000,))
            rows = kept.read("SELECT count(*) FROM kept")
        return state.settings().ports, authority.pem, rows


@pytest.fixture(autouse=True)
def _at_once(monkeypatch):
    # So often the ledger looks whether it is closed.
    monkeypatch.setattr(ledger, "_LOOK_S", 0.01)


@pytest.fixture
def folder(tmp_path):
    start(tmp_path / "cloud")
    return tmp_path / "cloud"


DAMAGES = {
    "half": lambda path: os.truncate(path, path.stat().st_size // 2),
    "empty": lambda path: os.truncate(path, 0),
    "other": lambda path: path.write_text("[5]"),
    "bytes": lambda path: path.write_bytes(b"\xff\x00" * 300),
}
# Only a start needs these, and it makes them anew.
REPAIRED = ("owner.id", "owner.key", "broker.pem")
TOLD = ("settings.json", "VERSION", "authority.pem", "authority.key", "page-password", "ledger.db")


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        (name, damage)
        for name in (*REPAIRED, *TOLD)
        for damage in DAMAGES
        # Half of it says the same.
        if (name, damage) != ("VERSION", "half")
    ],
)
def test_a_damaged_file_is_repaired_or_told(folder, name, damage):
    before = start(folder)
    DAMAGES[damage](folder / name)
    if name in REPAIRED:
        ports, pem, rows = start(folder)
        assert (ports, pem, rows[0][0]) == (*before[:2], before[2][0][0] + 1)
        return
    damaged = (folder / name).read_bytes()
    with pytest.raises((LocalError, StationError), match=re.escape(str(folder / name.replace("key", "pem")))):
        start(folder)
    assert (folder / name).read_bytes() == damaged


@pytest.mark.parametrize("name", ["settings.json", "authority.key", "authority.pem", "ledger.db"])
def test_a_missing_file_is_told(folder, name):
    (folder / name).unlink()
    with pytest.raises(
        LocalError, match=rf"{name}.* must be .*[Nn]o such file.*(put it back|`iort restore`)"
    ):
        start(folder)


@pytest.mark.parametrize(
    ("found", "why"),
    [
        (
            {"listen": 5},
            "listen must be hosts such as 192.168.1.10,iort.lab, or no, got 5: mend or remove it",
        ),
        ({"page": None}, "page must be hosts such as"),
        ({"power_cut": "1"}, "power_cut must be true or false, got '1'"),
        ({"ports": [8883]}, "ports must be an object with a port for each server, got [8883]"),
        ({"ports": {"mqtt": "8884"}}, "ports.mqtt must be a number from 1 to 65535, got '8884'"),
        ({"ports": {"mqtt": 70000}}, "ports.mqtt must be a number from 1 to 65535, got 70000"),
        ({"ports": {"mqtt": True}}, "ports.mqtt must be a number from 1 to 65535, got True"),
        ({"ports": {"mqqt": 8884}}, "a key must be one of ports.gateway, ports.mqtt,"),
        ({"listn": "no"}, "a key must be one of listen, page, power_cut, any_ports, ports, got listn"),
    ],
)
def test_settings_that_somebody_broke_are_an_error_that_says_so(folder, found, why):
    (folder / "settings.json").write_text(json.dumps(found))
    with pytest.raises(LocalError, match=re.escape(f"{folder / 'settings.json'}: {why}")):
        start(folder)


def as_nobody(folder):
    """Why a start fails for another user. The interpreter's own files may be its user's alone, so it goes on
    in a fork."""
    ours, childs = multiprocessing.Pipe(duplex=False)

    def start_there():
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)
        try:
            start(folder)
        except LocalError as error:
            childs.send(str(error))

    child = multiprocessing.get_context("fork").Process(target=start_there)
    child.start()
    childs.close()
    with ours:
        try:
            return ours.recv()
        finally:
            child.join()


def test_a_remembered_address_that_this_machine_has_not_is_told_with_its_file(folder):
    settings = json.loads((folder / "settings.json").read_text())
    (folder / "settings.json").write_text(json.dumps({**settings, "listen": "192.0.2.1"}))
    given = commands.parser("up", "", remembered=True).parse_args(["--state", str(folder)])
    with pytest.raises(LocalError) as error:
        run._Kept(given, threading.Event()).run()
    told = str(error.value)
    assert told.startswith("LISTEN must be an address of this machine, got 192.0.2.1: ")
    assert told.endswith(f"{folder / 'settings.json'} remembers it: give another LISTEN=, or LISTEN=no")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has files of several users")
@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda folder: os.chown(folder, 0, 0), r"cloud must belong to \w+, got root: .*`sudo chown -R \w+ "),
        (lambda folder: os.chown(folder / "owner.key", 0, 0), r"owner\.key must belong to \w+, got root"),
        (
            lambda folder: (folder / "ledger.db").chmod(0o400),
            r"read and write .*ledger\.db, got mode 400: `chmod",
        ),
        (lambda folder: folder.chmod(0o500), r"read and write .*cloud, got mode 500"),
        (lambda folder: folder.parent.chmod(0o700), "you must be able to read .*cloud: .*Permission denied"),
    ],
    ids=["folder", "file", "read-only file", "read-only folder", "unreachable"],
)
def test_files_that_are_not_the_users_own_are_told(damage, why):
    # pytest's folders are for their user alone.
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "cloud"
        start(folder)
        for path in (folder, *folder.iterdir(), folder.parent / "cloud.lock"):
            os.chown(path, NOBODY, NOBODY)
        os.chown(parent, 0, NOBODY)
        folder.parent.chmod(0o775)
        damage(folder)
        assert re.search(why, as_nobody(folder))
