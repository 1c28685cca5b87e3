"""What a robot has recorded in ten minutes, and is it complete? python docs/examples/library.py car7."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from iort_station import (
    Estimate,
    Finding,
    Incident,
    Lab,
    Laps,
    Message,
    Result,
    Robot,
    Run,
    StationError,
    Stream,
    UsageError,
    Verdict,
    connect,
)


def about(robot: Robot, stream: Stream, run: Run) -> str:
    """What ran, and in which units it recorded."""
    seconds = (run.to_us - run.from_us) / 1e6
    samples = run.streams.get(stream.name, {}).get("samples")
    units = ", ".join(f"{name} {unit}" for name, unit in stream.fields.items() if unit)
    return f"{robot.name} {run.state} after {seconds:.0f} s, {samples} samples of {stream.name}: {units}"


def fastest(ride: Result, proof: Verdict) -> str:
    """The highest speed, and the audit's word about the range that it is of."""
    speed: float = ride.polars()["speed_mps"].max()  # type: ignore[assignment]  # a column of numbers
    why = f": {'; '.join(proof.why)}" if proof.why else ""
    return f"{speed:.2f} {ride.unit('speed_mps')} of {len(ride)} samples, {proof.word}{why}"


def best(laps: Laps) -> Estimate | None:
    """The time of the best lap with its interval."""
    return laps.estimates.get("lap_best_s")


def said(incidents: list[Incident], findings: list[Finding]) -> Iterator[str]:
    """A line for each."""
    yield from (f"{one.robot} {one.trigger} {one.state}" for one in incidents)
    yield from (f"{one.drive.robot} {one.severity}: {one.text}" for one in findings)


def first(messages: Iterator[Message]) -> dict[str, int | float | str | bool | None]:
    """The fields of the first message."""
    return dict(next(messages).decode())


def main(robot: str) -> None:
    """Print what is known of a robot."""
    lab: Lab = connect()
    try:
        (this,) = (one for one in lab.robots() if one.name == robot)
        for stream in lab.streams(robot):
            for run in lab.runs(robot, "-10m"):
                print(about(this, stream, run))
        ride = lab.query(robot, "vesc", "-10m", fields=["speed_mps"])
        print(fastest(ride, lab.audit(robot, "vesc", "-10m")))
        print(*map(best, lab.laps(robot, "-10m")))
        print(*said(lab.incidents(robot), lab.findings(robot)), sep="\n")
        if any(stream.name == "scan" for stream in lab.streams(robot)):
            print(first(lab.messages(robot, "scan", "-10m")))
    except UsageError as error:
        sys.exit(f"wrong use: {error}")
    except StationError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(*sys.argv[1:])
