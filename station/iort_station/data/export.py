"""Writes a robot's samples into a recording: messages as published, or made of samples."""

from __future__ import annotations

import hashlib
import itertools
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from itertools import chain
from typing import NamedTuple

from iort_analysis.archive.hours import key_of
from iort_analysis.archive.stored import Origin, PageProgress
from iort_analysis.samples.batches import Item, RefusedItems, start_us
from iort_contract.codec import ROS2_CODEC
from iort_contract.dynamodb import plain, with_samples_between
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, messages_of
from iort_contract.messages.files import ATTACHMENT_AT, ATTACHMENT_FIELDS
from iort_contract.ros.message import ROS2, MessageType, filled
from iort_station import data
from iort_station.cloud import Cloud
from iort_station.data import inventory, ros_messages
from iort_station.data.bags import Recording, Topic
from iort_station.data.recorded import Recorded, Selection
from iort_station.data.ros_forms import ConversionError, from_ros2
from iort_station.fleet import files

# Gives the content of an uploaded file by its key; None if the file is missing.
Content = Callable[[str], "bytes | None"]


class Published(NamedTuple):
    """A message: the sample's time, the id of its type, and its bytes."""

    t_us: int
    type_id: str
    raw: bytes


class Export:
    """Reads a selection's messages. ``types`` are those that the robot has declared, by id.

    While it reads, ``types`` grows by the types that only batches name. ``others`` counts samples that are
    not messages; ``empty`` counts messages that have an empty array instead of a missing file.
    """

    def __init__(
        self,
        cloud: Cloud,
        selection: Selection,
        types: Mapping[str, MessageType],
        content: Content,
        origin: Origin | None = None,
    ) -> None:
        self.types = dict(types)
        self.others = self.empty = 0
        self._recorded = Recorded(cloud, selection.robot, selection.stream, origin=origin)
        self.refused = self._recorded.refused
        self._selection, self._content = selection, content
        self._layouts = {name: kind.layout for name, kind in types.items()}

    def messages(self, progress: PageProgress | None = None) -> Iterator[Published]:
        """The messages, in order of their batches' times."""
        for item in chain.from_iterable(self._pages(progress)):
            yield from self._of(item)

    def first(self) -> list[Published]:
        """The messages of the first page."""
        with closing(self._pages(None)) as pages:
            return [one for item in next(pages, ()) for one in self._of(item)]

    def in_order(self, progress: PageProgress | None = None) -> Generator[Published, None, None]:
        """The messages in order of their own times: batches may overlap."""
        held: list[Published] = []
        for item in chain.from_iterable(self._pages(progress)):
            # A later batch may still hold messages from its start on.
            final_us = start_us(item)
            yield from (one for one in held if one.t_us < final_us)
            held = [one for one in held if one.t_us >= final_us] + list(self._of(item))
            held.sort(key=lambda one: one.t_us)
        yield from held

    def _pages(self, progress: PageProgress | None) -> Generator[Sequence[Item], None, None]:
        keys = with_samples_between(self._selection.start_us, self._selection.end_us)
        yield from self._recorded.items(keys, progress=progress)

    def _of(self, item: Item) -> Sequence[Published]:
        try:
            batch, ros_messages = messages_of(plain(item), self._layouts)
        except ContractError as error:
            self.refused.add(error, key_of(item))
            return ()
        inside = [i for i, t_us in enumerate(batch.times_us) if self._selection.holds_time(t_us)]
        if ros_messages is None:
            self.others += len(inside)
            return ()
        if ros_messages.type_id not in self.types and not ros_messages.readable:
            self.refused.add(ContractError(f"the type {ros_messages.type_id} is not declared"), batch.id)
            return ()
        if ros_messages.type_id not in self.types:
            kind, _, definition = ros_messages.layout.partition("\n")
            stream = self._selection.stream
            self.types[ros_messages.type_id] = MessageType(stream, f"/{stream}", kind, "", definition)
        name, raws = ros_messages.type_id, ros_messages.raw
        ros2 = ros_messages.codec == ROS2_CODEC
        try:
            return [
                Published(batch.times_us[i], name, self._filled(raws[i], batch, i, ros2=ros2)) for i in inside
            ]
        except ContractError as error:
            self.refused.add(error, batch.id)
            return ()

    def _filled(self, raw: bytes, batch: Batch, i: int, *, ros2: bool) -> bytes:
        """The message with its files' contents: the content that was cut out last comes back first."""
        places = [name for name in batch.columns if name.endswith(f".{ATTACHMENT_AT}")]
        for place in reversed(places):
            at, field = batch.columns[place][i], place[: -len(ATTACHMENT_AT) - 1]
            # A message may itself have a field of that name.
            if type(at) is not int or not all(
                f"{field}.{part}" in batch.columns for part in ATTACHMENT_FIELDS
            ):
                continue
            key, sha256 = (batch.columns[f"{field}.{part}"][i] for part in ("key", "sha256"))
            content = self._content(key) if isinstance(key, str) else None
            if content is None or hashlib.sha256(content).hexdigest() != sha256:
                # The places of the contents before it are no longer known.
                self.empty += 1
                break
            raw = filled(raw, content, at, ros2=ros2)
        return raw


Say = Callable[[str], None]


def write(
    cloud: Cloud,
    selection: Selection,
    file: Recording,
    *,
    origin: Origin | None = None,
    refused: RefusedItems | None = None,
    say: Say = lambda _line: None,
    progress: PageProgress = lambda _more, _last_us: None,
) -> int:
    """Write the messages of a selection and return their number; ``say`` takes lines about the result,
    ``origin`` grows by what comes from the archive, and ``refused`` counts what cannot be exported.

    ROS messages are written as they were published, or in the form of the ROS whose messages ``file`` can
    hold. Other samples become messages of the type that their source gave, or of their fields.
    """
    robot, stream = selection.robot, selection.stream
    declared = ros_messages.types(cloud, robot)
    known = {name: kind for name, kind in declared.items() if kind.stream == stream}
    export = Export(cloud, selection, known, lambda key: files.content(cloud, key), origin)
    counts: Counter[str] = Counter()
    topics: dict[str, Topic] = {}
    unfit: list[str] = []
    for t_us, name, raw in export.messages(progress):
        if name not in topics:
            topics[name] = file.topic(export.types[name])
        try:
            topics[name].write(t_us * 1000, raw)
        except ConversionError as error:
            unfit.append(str(error))
        else:
            counts[name] += 1
    for name, topic in topics.items():
        kind = export.types[name]
        say(f"{robot} {stream}: {counts[name]:,} messages of {kind.kind} on {kind.topic}, {topic.form.note}")
        if name not in known:
            say("  its definition is not stored, so topic, comments and constants are not the publisher's")
    if unfit:
        say(f"{len(unfit):,} messages cannot be converted and are left out; the first: {unfit[0]}")
    if refused is not None:
        refused.count += export.refused.count
    if export.refused.count:
        say(f"{export.refused.count:,} stored items cannot be exported; the first: {export.refused.reason}")
    if export.empty:
        say(f"{export.empty} messages have an empty array: their content was not kept, or is not uploaded")
    made = _make(cloud, selection, file, list(declared.values()), say) if export.others else 0
    if not topics and not made and not export.refused.count:
        inventory.check_there(cloud, robot, stream)
        say(f"{robot} {stream}: no samples in this range")
    return sum(counts.values()) + made


def _make(
    cloud: Cloud, selection: Selection, file: Recording, declared: Sequence[MessageType], say: Say
) -> int:
    """Write messages made of the samples that are not ROS messages, and return their number."""
    robot, stream = selection.robot, selection.stream
    blocks = data.samples(cloud, selection, messages=False)
    known = [kind for kind in declared if kind.stream == stream]
    # If topics share a stream, nobody can tell which one a selection of fields belongs to.
    shared = len({kind.topic for kind in known}) > 1
    kind = ros_messages.in_ros1(known[-1]) if known and not shared else None
    # Beside messages of ROS 2, those without a type are ROS 2's, too.
    origin = ROS2 if any(map(from_ros2, declared)) else ""
    makers: dict[tuple[tuple[str, str], ...], tuple[ros_messages.Maker, Topic]] = {}
    numbers, written = itertools.count(), 0
    for block in blocks:
        # While a robot drives, fields come and go, and the kind of a field's values may change.
        shape = tuple(sorted((name, column.dtype.kind) for name, column in block.columns.items()))
        if shape not in makers:
            made = kind or ros_messages.made_of(stream, block.columns, len(makers))
            made = made._replace(converted_from=made.converted_from or origin)
            maker = ros_messages.Maker(made, list(block.columns), own=kind is None, numbers=numbers)
            makers[shape] = maker, file.topic(maker.kind)
        maker, topic = makers[shape]
        for t_ns, message in maker.messages(block):
            topic.write(t_ns, message)
            written += 1
    if not makers:
        return 0
    topics = ", ".join(dict.fromkeys(maker.kind.topic for maker, _ in makers.values()))
    say(f"{robot} {stream}: {written:,} messages of {topic.form.kind} on {topics}, made of samples")
    if shared:
        say(f"several topics of {robot} share {stream}, so the type is made of the selected fields")
    elif kind is None:
        say(f"{robot} has not sent the type of {stream}, so the type is made of its fields")
    if len(makers) > 1 and kind is None:
        say(f"its fields changed, so there are {len(makers)} types, each on a topic of its own")
    lacking = {name for maker, _ in makers.values() for name in maker.lacking}
    foreign = {name for maker, _ in makers.values() for name in maker.foreign}
    if lacking:
        say(f"missing in some or all samples, so zero or empty: {', '.join(sorted(lacking))}")
    if foreign:
        say(f"not in the type, so left out: {', '.join(sorted(foreign))}")
    return written
