"""The options of `make demo`."""

from __future__ import annotations

import argparse
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

from iort_agent.common.schema import Place
from iort_agent.common.threads import SystemClock
from iort_agent.errors import ConfigError, SourceError
from iort_agent.sources.recording import BagConfig, BagSource
from iort_agent.sources.sim.faults import fault_rule
from iort_contract.cloud import IOT, PUBNUB
from local.cloud import FOLDER


def read() -> argparse.Namespace:
    """The options; ends the process with an error if one is wrong."""
    parser = argparse.ArgumentParser(
        prog="make demo",
        usage="make demo [DURATION=20] [BAG=drive.bag] [FAULTS=kind:strength] [LIVE=pubnub] [REPORT=r.json] "
        "[PORT=8080]",
        description="A car drives through the embedded cloud, and the demo counts the samples that arrive.",
    )
    parser.add_argument("--duration", type=_positive, metavar="S", help="seconds to drive (default 60)")
    parser.add_argument(
        "--bag", type=Path, metavar="FILE", help="drive a recording instead of a simulated car"
    )
    parser.add_argument(
        "--faults", type=_faults, default=[], metavar="KIND:STRENGTH,...", help="of the simulated car"
    )
    parser.add_argument(
        "--live",
        choices=[IOT, PUBNUB],
        default=IOT,
        help="the way of live messages: AWS IoT's own, or PubNub's with a stand-in (default: %(default)s)",
    )
    parser.add_argument("--report", type=Path, metavar="FILE", help="write the figures as JSON")
    parser.add_argument("--port", type=int, default=0, help="the page's port (default: a free one)")
    parser.add_argument(
        "--folder", type=Path, default=FOLDER, help="where the embedded cloud keeps its state"
    )
    options = parser.parse_args()
    if options.bag is not None and not options.bag.exists():
        parser.error(f"BAG must exist, got {options.bag}")
    if options.bag is not None:
        try:
            with BagSource(BagConfig(path=options.bag), SystemClock()).open() as messages:
                next(messages, None)
        except SourceError as error:
            parser.error(f"BAG={error}")
        if options.faults:
            parser.error("FAULTS are those of a simulated car: give no BAG")
    if options.report is not None and not options.report.absolute().parent.is_dir():
        parser.error(f"REPORT must be in an existing folder, got {options.report}")
    if options.report is not None and options.report.is_dir():
        parser.error(f"REPORT must be a file, got the folder {options.report}")
    if not 0 <= options.port <= 65535:
        parser.error(f"PORT must be 1 to 65535, got {options.port}")
    try:
        socket.create_server(("127.0.0.1", options.port)).close()
    except OSError as error:
        parser.error(f"PORT must be free, got {options.port}: {error.strerror}; give none for a free one")
    return options


def _faults(value: str) -> list[dict[str, Any]]:
    """Faults as in a car.yaml, from a text such as ``worn_battery:strong,payload:1.2``."""
    faults: list[dict[str, Any]] = []
    for part in value.split(","):
        kind, _, strength = part.partition(":")
        fault: dict[str, Any] = {"kind": kind}
        if strength:
            with suppress(ValueError):
                fault["strength"] = float(strength)
            fault.setdefault("strength", strength)
        try:
            fault_rule(fault, Place(Path("FAULTS")))
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from error
        faults.append(fault)
    return faults


def _positive(value: str) -> float:
    try:
        seconds = float(value)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds <= 86_400:
        raise argparse.ArgumentTypeError(f"DURATION must be over 0 and at most 86400 s, got {value}")
    return seconds
