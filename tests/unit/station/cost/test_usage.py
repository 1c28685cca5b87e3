"""`iort cost --config` reads the same rates from a car.yaml as the agent."""

from __future__ import annotations

import json
from dataclasses import fields

import pytest
from typer.testing import CliRunner

from iort_agent.config import Config, load_config
from iort_agent.sources import SourceConfig
from iort_agent.sources.registry import SOURCES
from iort_agent.sources.sim import SimConfig
from iort_contract.messages.shadow import ALWAYS
from iort_station.cli.main import app
from iort_station.cost.usage import _OWN_RATE_HZ, Usage, as_configured
from iort_station.errors import StationError

NEEDED = "robot: car7\nendpoint: example.org\ncertificate: certificate.pem\nprivate_key: private.key\n"
SIM = "sources: [{type: sim}]\n"
RECORDING = "sources:\n- {type: bag, path: drive.bag, topics: {/core: vesc, /imu: imu, /imu2: imu}}\n"
ROS = (
    "sources:\n- type: ros1\n  topics: {/a: {stream: a, time: arrival}, /b: {stream: a, time: header}}\n"
    "- {type: vesc, port: /dev/ttyACM0, rate_hz: 3}\n"
)
# Every key that the command reads, with and without its default.
FILES = (
    SIM,
    "sources: [{type: sim, rate_hz: 10, pose: {rate_hz: 0}}]\n",
    RECORDING,
    ROS,
    "sources: [{type: vesc, port: /dev/vesc}, {type: bag, path: drive.bag, stream: tool}]\n",
    f"{SIM}live: {{rate_hz: 2}}\nrecord: {{batch_s: 0.5}}\nping: {{rate_hz: 1}}\nmetrics: {{every_s: 60}}\n",
    f"{ROS}live: {{enabled: false}}\nmetrics: {{enabled: false}}\n",
    f"{SIM}live: {{when: always, transport: pubnub}}\n",
)


@pytest.fixture
def car(tmp_path):
    """Writes a car.yaml."""

    def write(settings):
        for name in ("certificate.pem", "private.key", "drive.bag"):
            (tmp_path / name).touch()
        file = tmp_path / "car.yaml"
        file.write_text(NEEDED + settings)
        return file

    return write


def rates_of(source: SourceConfig) -> list[float | None]:
    if isinstance(source, SimConfig):
        return [source.rate_hz, min(source.rate_hz, source.pose.rate_hz)][: len(source.streams())]
    return [getattr(source, "rate_hz", None) for _ in set(source.streams())]


def in_the_agent(config: Config) -> dict[str, object]:
    known = [rate for source in config.sources for rate in rates_of(source)]
    return {
        "streams": len(known),
        "rate_hz": sum(rate or Usage().rate_hz for rate in known) / len(known),
        "live_hz": sum(min(config.live.rate_hz, rate or 1e9) for rate in known) * config.live.enabled,
        "batch_s": config.record.batch_s,
        "ping_hz": config.ping.rate_hz,
        "agent_every_s": config.metrics.every_s * config.metrics.enabled,
        "watched_hours": None if config.live.when == ALWAYS else Usage().watched_hours,
        "live_transport": config.live.transport if config.live.when == ALWAYS else Usage().live_transport,
    }


@pytest.mark.parametrize("settings", FILES)
def test_the_station_reads_the_same_rates_as_the_agent(car, settings):
    file = car(settings)
    usage = vars(as_configured(Usage(), file))
    expected = in_the_agent(load_config(file))
    assert {name: usage[name] for name in expected} == expected


def test_the_sources_with_a_rate_are_the_same_as_in_the_agent():
    rates = {
        kind: field.default
        for kind, config in SOURCES.items()
        for field in fields(config)
        if field.name == "rate_hz"
    }
    assert rates == _OWN_RATE_HZ


def test_the_command_reads_a_file_without_the_robots_certificate(tmp_path):
    file = tmp_path / "car.yaml"
    file.write_text(
        "live: {rate_hz: 4}\nsources:\n- {type: sim, rate_hz: 2}\n"
        "- type: rosbridge\n  url: ws://localhost:9090\n"
        "  topics: {/a: {stream: a, time: arrival}, /b: {stream: b, time: arrival}}\n"
    )
    given = ["cost", "--config", str(file), "--json"]
    done = CliRunner().invoke(app, given, env={"XDG_CACHE_HOME": str(tmp_path)})
    assert done.exit_code == 0, done.output
    usage = json.loads(done.output)["usage"]
    assert usage["live_hz"] == 2 + 2 + 2 * 4
    # One sample and one pose each half second, and two topics of unknown rate.
    assert (usage["streams"], usage["rate_hz"]) == (4, (2 + 2 + 50 + 50) / 4)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("", "'sources'"),
        ("sources: []\n", "requires at least one"),
        (f"{SIM}live: 5\n", "'int' object is not a mapping"),
        (f"{SIM}live: {{rate_hz: fast}}\n", "'fast'"),
        (f"{SIM}live: {{when: always, transport: post}}\n", "live_transport must be one of pubnub, iot"),
        ("sources: [{type: sim, rate_hz: -1}]", "rate_hz must be at least 0, got -1"),
        ("sources: [", "ParserError"),
        (None, "FileNotFoundError"),
    ],
)
def test_an_invalid_file_is_named_with_the_reason(car, tmp_path, settings, said):
    with pytest.raises(StationError, match=r"car\.yaml must be as `iort-agent check` accepts it") as error:
        as_configured(Usage(), tmp_path / "car.yaml" if settings is None else car(settings))
    assert said in str(error.value)
