"""What is stored of a robot: streams, types, fields and units; and the errors that name them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import suppress
from functools import lru_cache

from iort_analysis.samples.batches import RefusedItems, in_order, part
from iort_analysis.samples.blocks import EMPTY, Block, join, values
from iort_contract.catalog import streams
from iort_contract.catalog.derived import DERIVED, PARAMETERS, SOURCES
from iort_contract.catalog.vesc import LOG_UNITS, VESC, VESC_STREAM
from iort_contract.dynamodb import with_samples_between
from iort_contract.limits import ContractError, MessageError
from iort_contract.ros.definition import Fields, is_ros2, parse, short_kind
from iort_contract.ros.message import MessageType, message_type
from iort_contract.tables import STATS, STREAMS
from iort_station.cloud import Cloud
from iort_station.data.accounts import last_reports
from iort_station.data.recorded import Recorded, Selection
from iort_station.errors import StationError, unknown
from iort_station.fleet import registry
from iort_station.times import iso

VESC_KIND = "vesc_msgs/VescState"


def unit(stream: str, name: str, *, ros2: bool = False, kind: MessageType | None = None) -> str:
    """The unit of a field or of one of its statistics; empty if unknown.

    ``ros2`` tells that the samples are the ROS 2 driver's; ``kind`` is the type of the stream's messages.
    """
    stem, _, statistic = name.rpartition("_")
    for field in (name, stem) if statistic in STATS else (name,):
        if found := _unit(stream, field, kind, ros2=ros2):
            return found
    return ""


def _unit(stream: str, field: str, kind: MessageType | None, *, ros2: bool) -> str:
    if field in DERIVED:
        return DERIVED[field].unit
    if (
        kind is None
        and stream in streams.CATALOG
        and (found := streams.CATALOG[stream].unit(field, ros2=ros2))
    ):
        return found
    if kind is not None and (found := _by_type(kind, field, ros2=ros2)):
        return found
    if stream == VESC_STREAM and (found := VESC.unit(field, ros2=ros2)):
        return found
    name = "" if kind is None else short_kind(kind.kind)
    if field in LOG_UNITS and (stream == VESC_STREAM if kind is None else name == VESC_KIND):
        return LOG_UNITS[field]
    # The driver's VescImu has fields of these names in other units.
    if name.startswith("vesc_msgs/"):
        return ""
    within, _, axis = field.rpartition(".")
    known_as = (of for of in streams.ROS_UNITS if within == of or within.endswith(f".{of}"))
    return next((streams.ROS_UNITS[of] for of in known_as), "") if axis in {"x", "y", "z"} else ""


def _by_type(kind: MessageType, path: str, *, ros2: bool) -> str:
    types = _fields_of_type(kind.kind, kind.definition)
    name, ros2 = short_kind(kind.kind), ros2 or is_ros2(kind.kind)
    body = [field for field in types.get(name, ()) if field.name != "header"]
    # With a header and one other field, the sample's fields are that field's: see
    # contract/iort_contract/ros/decode.py.
    starts = [body[0].kind, name] if len(body) == 1 else [name]
    return next(filter(None, (_on_the_way(types, start, path, ros2=ros2) for start in starts)), "")


def _on_the_way(types: Mapping[str, Fields], kind: str, path: str, *, ros2: bool) -> str:
    """The unit that a type along the path gives to the next part of the path."""
    for name in path.split("."):
        if name.isdecimal():
            continue
        if kind.startswith(VESC_KIND) and (known := VESC.unit(name, ros2=ros2)):
            return known
        if name in streams.TYPE_UNITS.get(kind, {}):
            return streams.TYPE_UNITS[kind][name]
        kind = next((field.kind for field in types.get(kind, ()) if field.name == name), "")
    return ""


@lru_cache(maxsize=256)
def _fields_of_type(kind: str, definition: str) -> Mapping[str, Fields]:
    """The fields of a type and of the types inside it; empty for an invalid definition."""
    try:
        return parse(kind, definition).types
    except MessageError:
        return {}


# Every driver's VescState has these fields, and hardly any other message has.
_VESC_FIELDS = frozenset({"voltage_input", "current_motor", "duty_cycle"})


def check_there(cloud: Cloud, robot: str, stream: str) -> None:
    """Raise `StationError` for an unknown robot or stream, naming the nearest ones.

    The samples of a removed robot stay, and so does its name here.
    """
    if _has_batches(cloud, robot, stream):
        return
    has = check_recorded(cloud, robot)
    if not has:
        raise StationError(f"{robot} has no stream {stream}; it has sent nothing yet")
    raise unknown(f"{robot} has no stream {stream}", [stream], has, f"iort streams {robot}")


def check_recorded(cloud: Cloud, robot: str) -> list[str]:
    """The streams of a robot; raises `StationError` for one that has none and is not registered."""
    has = streams_of(cloud, robot)
    if not has:
        registry.get(cloud, robot)
    return has


def unknown_fields(cloud: Cloud, selection: Selection, there: AbstractSet[str]) -> StationError:
    """The error for a selection that names a field other than those ``there``, naming the nearest ones."""
    missing = sorted(selection.named() - there)
    stored_fields = _fields(cloud, selection)
    possible = stored_fields | {
        name for name, sources in SOURCES.items() if stored_fields.issuperset(sources)
    }
    for name in missing:
        if name in possible and PARAMETERS[name]:
            parameter = PARAMETERS[name][0]
            return StationError(
                f"{name} needs the {parameter} of {selection.robot}, which the registry lacks"
            )
    problem = f"{selection.robot} has no {', '.join(missing)} in {selection.stream} in this range"
    return unknown(problem, missing, possible, f"iort streams {selection.robot}")


def kind_of(cloud: Cloud, selection: Selection) -> MessageType | None:
    """The type of a stream's messages, which decides the units of its fields.

    It is the type that the robot published last before the range ends, or else its first. A stream without a
    published type, such as a VESC's log, has a VESC's type if it has a VESC's fields.
    """
    if selection.stream in {VESC_STREAM, *streams.OWN_STREAMS}:
        return None
    kinds = [
        (t_us, kind) for t_us, kind in types_of(cloud, selection.robot) if kind.stream == selection.stream
    ]
    before = [kind for t_us, kind in kinds if selection.end_us is None or t_us < selection.end_us]
    if kinds:
        return before[-1] if before else kinds[0][1]
    return assumed_kind(selection.stream, _fields(cloud, selection))


def assumed_kind(stream: str, fields: AbstractSet[str]) -> MessageType | None:
    """The type of a stream without a published one: a VESC's, or None."""
    return MessageType(stream, "", VESC_KIND, "", "") if fields >= _VESC_FIELDS else None


def types_of(cloud: Cloud, robot: str) -> Iterator[tuple[int, MessageType]]:
    """The message types that a robot has published, with the time of each, in order of time."""
    for block in _blocks(cloud, robot, streams.TYPES_STREAM):
        columns = {name: values(column) for name, column in block.columns.items()}
        for i, t_us in enumerate(block.times_us.tolist()):
            with suppress(ContractError):
                yield t_us, message_type({name: column[i] for name, column in columns.items()})


def streams_of(cloud: Cloud, robot: str) -> list[str]:
    """The robot's streams that have stored batches."""
    seen = _seen(cloud, robot)
    # The agent's reports of a year take seconds to read. The newest one names what Lambda 2 may not have
    # seen yet; the registry has forgotten a removed robot.
    names = {*seen, *_announced(cloud, robot, newest=True)} if seen else known(cloud, robot)
    return [
        name
        for name in sorted({VESC_STREAM, *streams.OWN_STREAMS, *names})
        if _has_batches(cloud, robot, name)
    ]


def known(cloud: Cloud, robot: str) -> list[str]:
    """The streams that the robot's agent has announced, that Lambda 2 has seen, or that every robot has."""
    announced = _announced(cloud, robot, newest=False)
    return sorted({VESC_STREAM, *streams.OWN_STREAMS, *_seen(cloud, robot), *announced})


def _seen(cloud: Cloud, robot: str) -> set[str]:
    row = registry.find(cloud, robot) or {}
    return {str(name) for name in row.get(STREAMS, ())}


def _announced(cloud: Cloud, robot: str, *, newest: bool) -> set[str]:
    """The streams that the agent has named in its types and accounts, or in the newest second of each."""
    if newest:
        blocks = [_newest_second(cloud, robot, own) for own in (streams.TYPES_STREAM, streams.ACCOUNT_STREAM)]
    else:
        reports = part(list(last_reports(cloud, robot)), RefusedItems()).block
        blocks = [*_blocks(cloud, robot, streams.TYPES_STREAM), reports]
    return {name for block in blocks for name in block.columns.get("stream", ()) if isinstance(name, str)}


def _newest_second(cloud: Cloud, robot: str, stream: str) -> Block:
    last = Recorded(cloud, robot, stream).before(None)
    return EMPTY if last is None else join(list(_blocks(cloud, robot, stream, last.t_us)))


def extent(cloud: Cloud, robot: str, stream: str) -> tuple[str, str] | None:
    """The start times of a stream's oldest and newest batches as ISO 8601; None if it has none."""
    recorded = Recorded(cloud, robot, stream)
    first, last = recorded.after(None), recorded.before(None)
    return None if first is None or last is None else (iso(first.t_us), iso(last.t_us))


def _has_batches(cloud: Cloud, robot: str, stream: str) -> bool:
    return Recorded(cloud, robot, stream).after(None) is not None


def _blocks(cloud: Cloud, robot: str, stream: str, start_us: int | None = None) -> Iterator[Block]:
    parts = Recorded(cloud, robot, stream).parts(with_samples_between(start_us, None))
    return in_order(parts)


def newest_block(cloud: Cloud, robot: str, stream: str) -> Block:
    """The samples of a stream's newest batch."""
    recorded = Recorded(cloud, robot, stream)
    last = recorded.before(None)
    return EMPTY if last is None else recorded.block(last)


def first_fields(cloud: Cloud, robot: str, stream: str) -> set[str]:
    """The fields of a stream's first stored samples."""
    return _fields(cloud, Selection(robot=robot, stream=stream))


def _fields(cloud: Cloud, selection: Selection) -> set[str]:
    """The fields of the first stored samples in the selection's range."""
    keys = with_samples_between(selection.start_us, selection.end_us)
    parts = Recorded(cloud, selection.robot, selection.stream).parts(keys)
    page = next(parts, None)
    return set() if page is None else set(page.block.columns)
