"""A run of the analysis: what is asked for, and the drives that its plan finds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping

from iort_contract.checks import integer, shown, text
from iort_contract.limits import ContractError
from iort_contract.messages.analysis.findings import DriveKey, Estimate, decode_estimate, encode_estimate
from iort_contract.messages.envelope import mapping, read
from iort_contract.topics import check_robot, check_stream


@dataclass(frozen=True)
class AnalysisRequest:
    """The drives of ``robots`` that begin from ``start_us`` to ``end_us`` (exclusive).

    No robots means all. With ``again`` also those that have been analysed. Of each robot at most ``most``
    drives are analysed, and the rest waits; 0 is no limit.
    """

    robots: tuple[str, ...]
    start_us: int
    end_us: int
    again: bool = False
    most: int = 0


@dataclass(frozen=True)
class PlannedDrive:
    """A drive to analyse: its samples lie from its start to ``end_us``, inclusive.

    ``motion`` names the stream that tells where it stood; empty if none does.
    """

    drive: DriveKey
    end_us: int
    streams: tuple[str, ...]
    motion: str = ""


@dataclass(frozen=True)
class AnalysedDrive:
    """The row of an analysed drive: what later drives are compared with.

    ``job`` is the run of the analysis that made it, at ``analysed_us`` (0: a version that did not tell).
    ``missing`` gives reasons by the names of what could not be computed.
    """

    drive: DriveKey
    end_us: int
    job: str
    samples: int
    estimates: Mapping[str, Estimate]
    missing: Mapping[str, str]
    repairs: Mapping[str, int]
    analysed_us: int = 0


def encode_request(request: AnalysisRequest) -> dict[str, Any]:
    """The request as the state machine's input."""
    return {
        "robots": list(request.robots),
        "start_us": request.start_us,
        "end_us": request.end_us,
        "again": request.again,
        "most": request.most,
    }


def decode_request(content: Mapping[str, Any], now_us: int) -> AnalysisRequest:
    """Decode a request; raises `ContractError`.

    The schedule gives ``last_s`` instead of times, which counts back from now.
    """
    robots = content.get("robots", [])
    if not isinstance(robots, list):
        raise ContractError(f"robots must be a list of names, got {shown(robots)}")
    if "last_s" in content:
        start_us, end_us = now_us - integer(content, "last_s") * 1_000_000, now_us
    else:
        start_us, end_us = integer(content, "start_us"), integer(content, "end_us")
    if end_us <= start_us:
        raise ContractError(f"the range must be longer than 0, got {(end_us - start_us) / 1e6:g} s")
    again = content.get("again", False)
    if not isinstance(again, bool):
        raise ContractError(f"again must be true or false, got {shown(again)}")
    most = integer(content, "most") if "most" in content else 0
    if most < 0:
        raise ContractError(f"most must be 0 or more, got {most}")
    return AnalysisRequest(tuple(map(check_robot, robots)), max(0, start_us), end_us, again, most)


def encode_planned(planned: PlannedDrive) -> dict[str, Any]:
    """The drive as an object for JSON."""
    return {
        **vars(planned.drive),
        "end_us": planned.end_us,
        "streams": list(planned.streams),
        "motion": planned.motion,
    }


def decode_planned(content: Mapping[str, Any]) -> PlannedDrive:
    """Decode a drive to analyse; raises `ContractError`."""
    planned = read(PlannedDrive, {**content, "drive": content}, drive=_drive)
    for stream in planned.streams:
        check_stream(stream)
    return planned


def encode_analysed(analysed: AnalysedDrive) -> dict[str, Any]:
    """The row's content as an object for JSON."""
    content = {name: value for name, value in vars(analysed).items() if name != "drive"}
    return {
        **vars(analysed.drive),
        **content,
        "estimates": {name: encode_estimate(one) for name, one in analysed.estimates.items()},
    }


def decode_analysed(content: Mapping[str, Any]) -> AnalysedDrive:
    """Decode a row's content; raises `ContractError`."""
    return AnalysedDrive(
        drive=_drive(content),
        end_us=integer(content, "end_us"),
        job=text(content, "job"),
        samples=integer(content, "samples"),
        estimates={name: decode_estimate(one) for name, one in mapping(content, "estimates").items()},
        missing={name: str(reason) for name, reason in mapping(content, "missing").items()},
        repairs={name: integer(mapping(content, "repairs"), name) for name in mapping(content, "repairs")},
        analysed_us=integer(content, "analysed_us") if "analysed_us" in content else 0,
    )


def _drive(content: Mapping[str, Any]) -> DriveKey:
    check_robot(text(content, "robot"))
    return read(DriveKey, content)
