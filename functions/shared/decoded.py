"""The records of a stream's event, read: good batches by topic, what is refused, and what has to wait."""

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
from functions.shared.share import REQUESTS_S, Change, Share, robot_of_change
from iort_contract import RECEIVED_MS, Batch, BatchId, ContractError, decode_item
from iort_contract.attributes import plain

_log = logging.getLogger(__name__)


@dataclass
class Decoded:
    """The good batches of some stream records by topic, what is wrong with others, and which have to wait;
    ``at_s`` is when the newest arrived in the table."""

    batches: dict[str, list[Batch]] = field(default_factory=lambda: defaultdict(list))
    records: dict[tuple[str, BatchId], Change] = field(default_factory=dict)
    refused: list[Refused] = field(default_factory=list)
    put_off: list[Change] = field(default_factory=list)
    at_s: float = 0.0

    def refuse(self, topic: str, keys: AbstractSet[BatchId], reason: str) -> None:
        """Count batches of a topic among what is refused."""
        self.batches[topic] = [batch for batch in self.batches[topic] if batch.id not in keys]
        for change in (self.records[topic, key] for key in sorted(keys)):
            self.refused.append(Refused(change["SequenceNumber"], reason, change["NewImage"]))

    def wait(self, topic: str) -> None:
        """Count the batches of a topic among those that have to wait."""
        self.put_off += [self.records[topic, batch.id] for batch in self.batches.pop(topic)]

    def news(self, since_ms: int) -> dict[str, list[Batch]]:
        """The batches that the cloud received at that time or later, of topics that have some."""
        found: dict[str, list[Batch]] = {}
        for topic, batches in self.batches.items():
            for batch in batches:
                received = self.records[topic, batch.id]["NewImage"].get(RECEIVED_MS)
                if received is None or Decimal(received["N"]) >= since_ms:
                    found.setdefault(topic, []).append(batch)
        return found


def decode_records(records: Iterable[Mapping[str, Any]], share: Share | None = None) -> Decoded:
    """Read stream records, each charged to its robot; what is over its share is not read. Removals (expiry)
    carry no image and are passed over."""
    share = share or Share.unlimited()
    decoded = Decoded()
    for record in records:
        change = record["dynamodb"]
        image = change.get("NewImage")
        if image is None:
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
