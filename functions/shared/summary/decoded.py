"""Decodes the records of a stream event: good batches by topic, refused ones, and waiting ones."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any

from functions.shared.dead_letter import Refused
from functions.shared.summary.share import REQUESTS_S, Change, Share, robot_of_change
from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, BatchId, decode_item
from iort_contract.tables import PUT_OFF_TO_S, RECEIVED_MS

_log = logging.getLogger(__name__)


@dataclass
class Decoded:
    """The good batches of some stream records by topic, the refused ones, and the waiting ones; ``at_s`` is
    the newest arrival in the table."""

    batches: dict[str, list[Batch]] = field(default_factory=lambda: defaultdict(list))
    records: dict[tuple[str, BatchId], Change] = field(default_factory=dict)
    refused: list[Refused] = field(default_factory=list)
    put_off: list[Change] = field(default_factory=list)
    at_s: float = 0.0

    def refuse(self, topic: str, keys: AbstractSet[BatchId], reason: str) -> None:
        """Add batches of a topic to the refused ones."""
        self.batches[topic] = [batch for batch in self.batches[topic] if batch.id not in keys]
        for change in (self.records[topic, key] for key in sorted(keys)):
            self.refused.append(Refused(change["SequenceNumber"], reason, change["NewImage"]))

    def wait(self, topic: str) -> None:
        """Move the batches of a topic to the waiting ones."""
        self.put_off += [self.records[topic, batch.id] for batch in self.batches.pop(topic)]

    def news(self, since_ms: int) -> dict[str, list[Batch]]:
        """The batches that the cloud received since then, by topic."""
        found: dict[str, list[Batch]] = {}
        for topic, batches in self.batches.items():
            for batch in batches:
                received = self.records[topic, batch.id]["NewImage"].get(RECEIVED_MS)
                if received is None or Decimal(received["N"]) >= since_ms:
                    found.setdefault(topic, []).append(batch)
        return found


def decode_records(records: Iterable[Mapping[str, Any]], share: Share | None = None) -> Decoded:
    """Decode stream records and charge each to its robot. Records over the robot's share are not decoded.
    Removals (expiry) carry no image and are skipped, and so are expiries that the archive has put off."""
    share = share or Share.unlimited()
    decoded = Decoded()
    for record in records:
        change = record["dynamodb"]
        image = change.get("NewImage")
        # The rule stores a batch that is sent again as a whole, without this attribute.
        if image is None or (record["eventName"] == "MODIFY" and PUT_OFF_TO_S in image):
            continue
        at_s = float(change.get("ApproximateCreationDateTime", time.time()))
        decoded.at_s = max(decoded.at_s, at_s)
        robot = robot_of_change(change)
        if robot and share.over(robot, at_s):
            decoded.put_off.append(change)
            continue
        meter = share.meter(robot, at_s)
        try:
            topic, batch = decode_item(plain(image))
        except ContractError as error:
            _log.warning("refused %s of %s: %s", change["Keys"], record["eventID"], error)
            decoded.refused.append(Refused(change["SequenceNumber"], str(error), image))
            meter.charge(REQUESTS_S)
        else:
            decoded.batches[str(topic)].append(batch)
            decoded.records[str(topic), batch.id] = change
            meter.charge()
    return decoded
