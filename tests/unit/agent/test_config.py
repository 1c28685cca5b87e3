"""The configuration file: its settings and its errors."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from iort_agent.common.threads import SystemClock
from iort_agent.config import load_config
from iort_agent.errors import ConfigError
from iort_agent.sources.recording import BagConfig
from iort_agent.sources.sim import SimConfig
from iort_agent.spool import QueueConfig, default_path
from iort_agent.spool.sqlite import make_spool

GOOD = """\
robot: car1
endpoint: abc-ats.iot.eu-west-1.amazonaws.com
certificate: pki/cert.pem
private_key: pki/key.pem
root_ca: pki/ca.pem
sources:
  - type: sim
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "pki").mkdir()
    for name in ("cert.pem", "key.pem", "ca.pem"):
        (tmp_path / "pki" / name).write_text("x")
    (tmp_path / "drive.bag").write_text("x")
    return tmp_path


def write(folder: Path, text: str) -> Path:
    file = folder / "car.yaml"
    file.write_text(text)
    return file


def test_a_short_file_is_enough(folder: Path) -> None:
    config = load_config(write(folder, GOOD))
    assert (config.robot, config.namespace, config.port) == ("car1", "iort", 8883)
    assert config.certificate == folder / "pki" / "cert.pem", "relative to the file"
    assert config.sources == (SimConfig(),)
    assert (config.record.batch_s, config.live.rate_hz, config.ping.rate_hz) == (1.0, 10.0, 0.0)
    assert config.queue.policy == "OverwriteOldestData"


def test_every_section_is_read(folder: Path) -> None:
    text = GOOD.replace("  - type: sim\n", "") + (
        "  - {type: bag, path: drive.bag, topics: {/sensors/core: vesc, /imu: imu}, speed: 0,\n"
        "     stamps: original, loop: true, duration_s: 5}\n"
        "  - {type: sim, stream: sim, rate_hz: 100, duration_s: 2, seed: 3, vehicle: {mass_kg: 5}}\n"
        "namespace: dev\nport: 443\n"
        "record: {enabled: false, batch_s: 0.1}\nlive: {enabled: false, rate_hz: 2}\n"
        "ping: {rate_hz: 10, paths: [rule], padding_bytes: 450}\n"
        "queue: {max_bytes: 1000000, policy: RejectNewData}\n"
    )
    config = load_config(write(folder, text))
    bag, sim = config.sources
    assert bag == BagConfig(
        path=folder / "drive.bag",
        topics=(("/sensors/core", "vesc"), ("/imu", "imu")),
        speed=0,
        stamps="original",
        loop=True,
        duration_s=5,
    )
    assert isinstance(sim, SimConfig)
    assert (sim.rate_hz, sim.seed, sim.vehicle.mass_kg) == (100, 3, 5)
    assert config.record.enabled is config.live.enabled is False
    assert config.ping.paths == ("rule",)


def test_an_empty_section_has_its_defaults(folder: Path) -> None:
    assert load_config(write(folder, GOOD + "live:\n")).live.rate_hz == 10


def test_the_queues_path_is_relative_to_the_file(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    monkeypatch.chdir(elsewhere)
    monkeypatch.setenv("HOME", str(elsewhere))
    for said, meant in (
        ("pki/queue.db", folder / "pki" / "queue.db"),
        (str(elsewhere / "queue.db"), elsewhere / "queue.db"),
        ("~/queue.db", elsewhere / "queue.db"),
    ):
        config = load_config(write(folder, f"{GOOD}queue: {{path: {said}}}\n"))
        assert config.queue.path == meant
        assert not meant.exists(), "reading a configuration makes nothing"


@pytest.mark.parametrize(
    "queue", ["", "queue:\n", "queue: {}\n", "queue: {path: }\n", "queue: {max_bytes: 200000}\n"]
)
def test_the_queue_is_beside_the_file_unless_it_says_where(folder: Path, queue: str) -> None:
    assert load_config(write(folder, GOOD + queue)).queue.path == folder / "car1.queue.db"


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"STATE_DIRECTORY": "{home}/a:{home}/b"}, "a"),
        ({"XDG_STATE_HOME": "{home}/state"}, "state/iort"),
        ({}, ".local/state/iort"),
    ],
)
def test_beside_a_read_only_configuration_the_queue_is_in_the_folder_of_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], expected: str
) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {"HOME": "{home}", **environment}.items():
        monkeypatch.setenv(name, value.format(home=tmp_path))
    # A folder that is not there may not be written, not even by root.
    path = default_path(tmp_path / "read_only" / "car.yaml", "car1")
    assert path == tmp_path / expected / "car1.queue.db"
    make_spool(QueueConfig(path), SystemClock()).close()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700


SIM = "  - type: sim\n"
DRIVE = "topic: /drive, type: ackermann_msgs/AckermannDriveStamped"
STOP, CRAWL = "motion: {stop: {}}", "motion: {stop: {drive: {speed: 0.1}}}"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("robot: car1\n", ""), "robot: required"),
        (("car1", "car/1"), "robot: ... 'car/1' ... A-Z a-z 0-9 _ -"),
        (("robot: car1", "robot: 17"), "robot: ... 17 (a number) ... a text ... quotes"),
        (("robot: car1", "robot: {a: 1}"), "robot: ... (a mapping) ... a text"),
        (("robot:", "robto: x\nrobot:"), "robto: unknown key ... one of robot, ... did you mean robot?"),
        (("robot:", "robot: x\nrobot:"), "the key 'robot' is given twice ... line 2"),
        (("pki/key.pem", "pki/no.pem"), "private_key: ... 'pki/no.pem' ... file that exists ... /pki/no.pem"),
        (("pki/key.pem", "pki"), "private_key: ... 'pki' ... a file that exists"),
        (("abc-ats", "https://abc-ats"), "endpoint: ... 'https://abc-ats ... a host name"),
        ((SIM, ""), "sources: must be ... got nothing ... at least one source"),
        ((SIM, "  []\n"), "sources: must be ... got [] (a list) ... at least one source"),
        ((SIM, "  - sim\n"), "sources[0]: must be ... got 'sim' ... a mapping with the key type"),
        (
            (SIM, "  - {}\n"),
            "sources[0].type: must be ... got nothing ... bag, ros1, ros2, rosbridge, sim, vesc",
        ),
        ((SIM, "  - {type: sum}\n"), "sources[0].type: ... got 'sum' ... bag, ros1 ... did you mean sim?"),
        ((SIM, SIM + "    rate_hz: fast\n"), "sources[0].rate_hz: ... got 'fast' ... 0.1 to 2000 (Hz)"),
        ((SIM, SIM + "    rate_hz: .nan\n"), "sources[0].rate_hz: must be ... got nan ... 0.1 to 2000"),
        ((SIM, SIM + "    seed: 1.5\n"), "sources[0].seed: must be ... got 1.5 ... a whole number"),
        ((SIM, SIM + "    stream: a/b\n"), "sources[0].stream: ... 'a/b'"),
        ((SIM, SIM + "    stream: rtt\n"), "sources[0]: ... the stream rtt is taken"),
        ((SIM, SIM + SIM), "sources[1]: ... the stream vesc is taken"),
        ((SIM, SIM + "    vehicle: {mas_kg: 2}\n"), "vehicle.mas_kg: unknown key ... did you mean mass_kg?"),
        ((SIM, "  - {type: bag}\n"), "sources[0].path: required"),
        ((SIM, "  - {type: bag, path: no.bag}\n"), "sources[0].path: must be ... got 'no.bag' ... exists"),
        ((SIM, "  - {type: bag, path: drive.bag, speed: -1}\n"), "speed: must be ... got -1 ... from 0"),
        ((SIM, "  - {type: bag, path: drive.bag, stamps: new}\n"), "stamps: ... got 'new' ... now, original"),
        (
            (SIM, "  - {type: bag, path: drive.bag, loop: 1}\n"),
            "loop: must be ... got 1 (a number) ... true or false",
        ),
        ((SIM, "  - {type: bag, path: drive.bag, topics: [/a]}\n"), "topics: ... mapping of ROS topic"),
        ((SIM, "  - {type: bag, path: drive.bag, topics: {/a: 'b c'}}\n"), "topics./a: ... 'b c'"),
        ((SIM, SIM + "live: {rate_hz: 50}\n"), "live.rate_hz: must be ... got 50 ... from 0.01 to 10 (Hz)"),
        ((SIM, SIM + "live: yes\n"), "live: must be ... got True (true or false) ... enabled, rate_hz"),
        ((SIM, SIM + "record: {batch_s: 2}\n"), "record.batch_s: must be ... got 2 ... from 0 to 1 (s)"),
        ((SIM, SIM + "ping: {paths: [brokr]}\n"), "ping.paths[0]: ... got 'brokr' ... did you mean broker?"),
        ((SIM, SIM + "ping: {paths: broker}\n"), "ping.paths: must be ... got 'broker' ... a list"),
        ((SIM, SIM + "queue: {policy: Drop}\n"), "queue.policy: must be ... got 'Drop' ... RejectNewData"),
        (
            (SIM, SIM + "queue: {path: away/queue.db}\n"),
            "queue.path: must be ... got 'away/queue.db' ... a folder that exists ... there is no ... /away",
        ),
        ((SIM, SIM + "queue: {path: pki}\n"), "queue.path: must be ... got 'pki' ... nothing else already"),
        ((SIM, SIM + "queue: {path: car.yaml}\n"), "queue.path: ... nothing else already"),
        ((SIM, SIM + "queue: {path: 7}\n"), "queue.path: ... got 7 (a number) ... the path of a file"),
        (
            (SIM, f"{SIM}downlink: {{cmd: {{a: {{{DRIVE}, {STOP}}}, b: {{{DRIVE}}}}}}}\n"),
            "downlink: cmd.b must have motion, as cmd.a has: /drive moves the robot",
        ),
        (
            (SIM, f"{SIM}downlink: {{cmd: {{a: {{{DRIVE}, {STOP}}}, b: {{{DRIVE}, {CRAWL}}}}}}}\n"),
            "downlink: cmd.b must have the type and motion.stop of cmd.a: both are for /drive",
        ),
        ((SIM, SIM + "port: 88830\n"), "port: must be ... got 88830 ... 1 to 65535"),
        ((SIM, SIM + "namespace: Iort\n"), "namespace: ... 'Iort' ... lower-case"),
        ((SIM, "  - type: sim\n   x: 1\n"), "is not YAML ... line 8"),
        ((SIM, f"  - {'[' * 5000}\n"), "car.yaml: must be nested at most"),
    ],
    ids=lambda case: case[1].strip()[:40] if isinstance(case, tuple) else "",
)
def test_an_error_names_key_value_and_what_is_allowed(
    folder: Path, change: tuple[str, str], said: str
) -> None:
    assert change[0] in GOOD
    file = write(folder, GOOD.replace(change[0], change[1]))
    with pytest.raises(ConfigError) as raised:
        load_config(file)
    for part in [str(file), *said.split(" ... ")]:
        assert part in str(raised.value)


@pytest.mark.parametrize("text", ["", "# nothing\n", "- a\n", "just text\n"])
def test_a_file_must_be_a_mapping(folder: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"car\.yaml: (is empty|must be a mapping)"):
        load_config(write(folder, text))


def test_an_unreadable_file(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"no\.yaml: cannot be read: No such file"):
        load_config(folder / "no.yaml")
    (folder / "latin.yaml").write_bytes(b"robot: \xe9")
    with pytest.raises(ConfigError, match="is not UTF-8"):
        load_config(folder / "latin.yaml")
