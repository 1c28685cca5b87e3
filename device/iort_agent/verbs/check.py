"""`iort-agent check`: finds what would not work. It changes nothing, and does not disturb a running agent.

Each source checks itself: see `iort_agent.sources.SourceConfig.check`.
"""

from __future__ import annotations

import os
import shutil
import stat
import time
from contextlib import suppress
from pathlib import Path
from typing import Iterator

from iort_agent.common.state import Status
from iort_agent.config import Config
from iort_agent.errors import AgentError, IdentityError, NotRunningError
from iort_agent.identity import Certificate, check_pair, read_certificate
from iort_agent.lanes.record import TODO, too_many
from iort_agent.recorder.folder import LEAST_BYTES
from iort_agent.recorder.segment import require_mcap
from iort_agent.sources import FAIL, OK, WARN, Finding
from iort_agent.sources.ros1 import Ros1Config
from iort_agent.sources.ros2 import Ros2Config, middleware
from iort_agent.status import ask
from iort_agent.verbs.connectivity import check_connection
from iort_contract.messages.commands import NO_MOTION

_NOT_YET = "not yet"
_MIDDLEWARES = {
    "rmw_fastrtps_cpp": "Fast DDS",
    "rmw_cyclonedds_cpp": "Cyclone DDS",
    "rmw_zenoh_cpp": "Zenoh",
}
_EXPIRES_SOON_S = 30 * 86_400
_LEAST_FREE_BYTES = 50_000_000


def check(config: Config, status_socket: Path) -> Iterator[Finding]:
    """Check everything that the configuration names, one finding after another."""
    running = _running(status_socket)
    yield from _identity(config)
    yield from check_connection(config, running)
    for i, source in enumerate(config.sources):
        yield from source.check(f"source {i} ({source.describe()})")
    yield from _queue(config)
    yield from _recorder(config)
    yield from _video(config, running)
    yield _lanes(config)
    yield emergency_stop(config)
    yield from rows(config, running)
    if running is None:
        yield Finding("agent", OK, "not running")
    else:
        yield Finding("agent", OK, f"running, process {running.pid}: see `iort-agent status`")


def render(finding: Finding) -> str:
    """A line for a person."""
    todo = f"\n      -> {finding.todo}" if finding.todo and finding.level != OK else ""
    return f"{finding.level:<5} {finding.what}: {finding.text}{todo}"


def _running(status_socket: Path) -> Status | None:
    try:
        return ask(status_socket)
    except NotRunningError:
        return None


def _identity(config: Config) -> Iterator[Finding]:
    try:
        validity = _validity(read_certificate(config.certificate))
    except IdentityError as error:
        yield Finding("certificate", FAIL, str(error), "`iort robots add` or `iort-agent provision` gets one")
    else:
        yield validity
        try:
            check_pair(config.certificate, config.private_key)
        except IdentityError as error:
            yield Finding("private key", FAIL, str(error), "put the two files of one bundle side by side")
        else:
            yield Finding("private key", OK, "is the certificate's")
    mode = stat.S_IMODE(config.private_key.stat().st_mode)
    if mode & 0o077:
        todo = f"chmod 600 {config.private_key}"
        yield Finding("key's mode", WARN, f"{mode:03o}: others may read it", todo)
    else:
        yield Finding("key's mode", OK, f"{mode:03o}")


def _validity(certificate: Certificate) -> Finding:
    now_s, validity = time.time(), certificate.validity()
    day = time.strftime("%Y-%m-%d", time.gmtime(validity.not_after_s))
    if now_s > validity.not_after_s:
        return Finding("certificate", FAIL, f"expired on {day}", "get a new one: `iort-agent renew`")
    if now_s < validity.not_before_s:
        return Finding("certificate", FAIL, "not valid yet, by this machine's clock", "set the clock")
    if validity.not_after_s - now_s < _EXPIRES_SOON_S:
        return Finding("certificate", WARN, f"expires on {day}", "get a new one: `iort-agent renew`")
    return Finding("certificate", OK, f"{certificate.id[:16]}..., valid until {day}")


def _queue(config: Config) -> Iterator[Finding]:
    path = config.queue.path
    assert path is not None, "as the configuration is loaded"
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    target = path if path.exists() else path.parent
    if not os.access(target, os.W_OK) or not os.access(path.parent, os.W_OK):
        yield Finding("queue", FAIL, f"{target} may not be written", f"chown it to {os.environ.get('USER')}")
        return
    free = shutil.disk_usage(path.parent).free
    used = path.stat().st_size if path.exists() else 0
    text = f"{path}, {used / 1e6:.1f} MB used of {config.queue.max_bytes / 1e6:.0f}, {free / 1e6:.0f} MB free"
    if free < _LEAST_FREE_BYTES:
        yield Finding("queue", FAIL, text, "free some of the disk: batches will be dropped")
    elif free < config.queue.max_bytes - used:
        yield Finding("queue", WARN, text, "the disk is full before the queue is: lower queue.max_bytes")
    else:
        yield Finding("queue", OK, text)


def _recorder(config: Config) -> Iterator[Finding]:
    recorder = config.recorder
    if recorder is None:
        return
    assert recorder.folder is not None, "as the configuration is loaded"
    try:
        require_mcap()
    except AgentError as error:
        yield Finding("recorder", FAIL, str(error), "or take the section `recorder` out")
        return
    place = next(folder for folder in (recorder.folder, *recorder.folder.parents) if folder.is_dir())
    if not os.access(place, os.W_OK):
        yield Finding(
            "recorder", FAIL, f"{place} may not be written", f"chown it to {os.environ.get('USER')}"
        )
        return
    disk = shutil.disk_usage(place)
    used = sum(path.stat().st_size for path in recorder.folder.glob("*.mcap"))
    allowed = min(recorder.max_mb * 1e6, recorder.max_disk_share * disk.total)
    room = disk.free + used - max(recorder.keep_free_mb * 1e6, config.queue.max_bytes)
    text = (
        f"{recorder.folder}, {used / 1e6:.0f} MB used of {allowed / 1e6:.0f}, {disk.free / 1e6:.0f} MB free"
    )
    if room < LEAST_BYTES:
        yield Finding("recorder", FAIL, text, "free some of the disk: the ring keeps nothing")
    elif room < allowed:
        yield Finding(
            "recorder", WARN, text, f"the disk has room for {room / 1e6:.0f} MB: lower recorder.max_mb"
        )
    else:
        yield Finding("recorder", OK, text)


def _video(config: Config, running: Status | None) -> Iterator[Finding]:
    if config.video is None:
        return
    yield from config.video.check()
    if running is None or running.video is None:
        return
    wrong = [
        alarm
        for alarm in running.alarms
        if alarm.startswith(("video", "the thread camera", "the thread video"))
    ]
    if wrong:
        yield Finding("camera", FAIL, "; ".join(wrong), "nobody can drive by sight: see `iort-agent status`")
    elif running.video.get("open"):
        viewers, watchers, kbps = (
            running.video.get(name, 0) for name in ("viewers", "watchers", "bitrate_kbps")
        )
        text = f"{viewers} viewer(s) at {kbps} kbit/s, {watchers} of pictures over the broker"
        yield Finding("camera", OK, text)
    else:
        yield Finding("camera", OK, "nobody looks, so it is closed")


def emergency_stop(config: Config) -> Finding:
    """Whether the robot can be stopped from afar."""
    commands = [name for name, command in config.downlink.cmd if command.motion is not None]
    if not commands:
        todo = "give downlink.cmd a command with motion, or whoever can stop the robot another way"
        return Finding("emergency stop", WARN, f"does nothing here: {NO_MOTION}", todo)
    return Finding("emergency stop", OK, f"ends what {', '.join(commands)} moves")


def rows(config: Config, running: Status | None) -> Iterator[Finding]:
    """The robot's row in the table of docs/how-to/ros2.md, with what its running agent has seen."""
    for i, source in enumerate(config.sources):
        if isinstance(source, Ros2Config):
            try:
                name = middleware()
            except Exception:  # noqa: BLE001, S112 - the source's own check has said it
                continue
            robot = [os.environ.get("ROS_DISTRO", "ROS 2").capitalize(), _MIDDLEWARES.get(name, name)]
        elif isinstance(source, Ros1Config):
            robot = [os.environ.get("ROS_DISTRO", "ROS 1").capitalize(), "TCPROS"]
        else:
            continue
        counts = running.sources[i] if running is not None and i < len(running.sources) else {}
        topics = [topic["messages"] for topic in counts.values() if isinstance(topic, dict)]
        heard = f"{sum(map(bool, topics))} topics, {sum(topics):,} messages" if any(topics) else _NOT_YET
        downlink = (running.downlink if running is not None else None) or {}
        commands = sum(command["passed"] for command in downlink.get("commands", {}).values())
        peers = sum(sum(robots.values()) for robots in downlink.get("fleet", {}).values())
        passed = f"{commands:,} commands, {peers:,} of peers" if commands or peers else _NOT_YET
        yield Finding("row", OK, f"| {' | '.join([*robot, heard, passed])} |")


def _lanes(config: Config) -> Finding:
    problem = too_many(config.sources, config.record)
    if problem is not None:
        return Finding("record lane", WARN, problem, TODO)
    return Finding("record lane", OK, "the streams named are few enough for one connection")
