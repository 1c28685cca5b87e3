"""Reads ROS messages as published out of the stored batches."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from iort_analysis.archive.hours import key_of
from iort_analysis.archive.stored import Origin, PageProgress
from iort_analysis.samples.batches import Item
from iort_contract.dynamodb import plain, with_samples_between
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, messages_of
from iort_contract.messages.message_type import MessageType
from iort_contract.messages.requests.files import ATTACHMENT_AT, ATTACHMENT_FIELDS
from iort_contract.ros1.message import filled
from iort_station.cloud import Cloud
from iort_station.data.selection import Selection
from iort_station.data.stored.recorded import Recorded

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
        keys = with_samples_between(self._selection.start_us, self._selection.end_us)
        for items in self._recorded.items(keys, progress=progress):
            for item in items:
                yield from self._of(item)

    def _of(self, item: Item) -> Sequence[Published]:
        try:
            batch, messages = messages_of(plain(item), self._layouts)
        except ContractError as error:
            self.refused.add(error, key_of(item))
            return ()
        inside = [i for i, t_us in enumerate(batch.times_us) if self._selection.holds_time(t_us)]
        if messages is None:
            self.others += len(inside)
            return ()
        if messages.type_id not in self.types and not messages.layout:
            self.refused.add(ContractError(f"the type {messages.type_id} is not declared"), batch.id)
            return ()
        if messages.type_id not in self.types:
            kind, _, definition = messages.layout.partition("\n")
            stream = self._selection.stream
            self.types[messages.type_id] = MessageType(stream, f"/{stream}", kind, "", definition)
        name, raws = messages.type_id, messages.raw
        try:
            return [Published(batch.times_us[i], name, self._filled(raws[i], batch, i)) for i in inside]
        except ContractError as error:
            self.refused.add(error, batch.id)
            return ()

    def _filled(self, raw: bytes, batch: Batch, i: int) -> bytes:
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
            raw = filled(raw, content, at)
        return raw
