"""Incidents: what the event recorders of robots have kept, by the samples of their stream `incidents`."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from iort_analysis.samples.blocks import values
from iort_contract.catalog.streams import INCIDENT_STREAM
from iort_contract.limits import ContractError, Value
from iort_contract.messages.recorder import KEPT, MAX_SPAN_S, TAKE, Incident, Take, incident, incident_id
from iort_station.cloud import Cloud
from iort_station.data.findings import robots_of
from iort_station.data.queries import samples
from iort_station.data.recorded import select
from iort_station.fleet import registry

_READERS = 8
# The samples of an incident come after its window has begun, and a robot's clock may be set meanwhile.
_SLACK_US = round(2 * MAX_SPAN_S * 1_000_000)


class RobotIncident(NamedTuple):
    """An incident of a robot in its newest state, and the time of that state."""

    robot: str
    t_us: int
    incident: Incident


def incidents(
    cloud: Cloud, robot: str | None = None, start_us: int | None = None, end_us: int | None = None
) -> list[RobotIncident]:
    """The incidents whose window has a part in a range, the newest first; of all robots without one."""
    robots = robots_of(cloud, robot if robot is None else registry.checked(robot))
    # Threads share clients, and must not make one at the same time.
    for service in ("dynamodb", "s3"):
        cloud.client(service)
    with ThreadPoolExecutor(_READERS) as pool:
        each = list(pool.map(lambda name: list(_of(cloud, name, start_us, end_us)), robots))
    found = [one for some in each for one in some]
    return sorted(found, key=lambda one: (-one.incident.from_us, one.robot, one.incident.id))


def of_take(
    cloud: Cloud, robot: str, taken: Take, before: Collection[RobotIncident] = ()
) -> RobotIncident | None:
    """What has become of a take; None if the cloud knows nothing of it yet.

    A take whose time overlaps an open incident becomes a part of that one. ``before`` are the incidents as
    they were before the take.
    """
    found = incidents(cloud, robot, taken.from_us, taken.to_us)
    own = incident_id(robot, taken.id, 0)
    part_of = (
        one
        for one in found
        if one not in before
        and TAKE in one.incident.trigger.split(",")
        and one.incident.from_us <= taken.from_us
        and taken.to_us <= one.incident.to_us
    )
    return next((one for one in found if one.incident.id == own), None) or next(part_of, None)


def _of(cloud: Cloud, robot: str, start_us: int | None, end_us: int | None) -> Iterator[RobotIncident]:
    # The newest state may have come long after the range.
    since_us = None if start_us is None else start_us - _SLACK_US
    newest: dict[str, RobotIncident] = {}
    for block in samples(cloud, select(robot, INCIDENT_STREAM, since_us)):
        columns = {name: values(column) for name, column in block.columns.items()}
        for i, t_us in enumerate(block.times_us.tolist()):
            try:
                one = RobotIncident(robot, t_us, _incident({name: of[i] for name, of in columns.items()}))
            except ContractError:
                continue  # of a later version, or no incident
            if one.incident.id not in newest or _age(newest[one.incident.id]) <= _age(one):
                newest[one.incident.id] = one
    for one in newest.values():
        if (end_us is None or one.incident.from_us < end_us) and (
            start_us is None or one.incident.to_us >= start_us
        ):
            yield one


def _incident(sample: Mapping[str, Value]) -> Incident:
    # Stored numbers are read as floats.
    return incident(
        {name: int(of) if isinstance(of, float) and of.is_integer() else of for name, of in sample.items()}
    )


def _age(one: RobotIncident) -> tuple[bool, int]:
    # Every other state follows `KEPT`, also if the robot's clock was set back between them.
    return one.incident.state != KEPT, one.t_us
