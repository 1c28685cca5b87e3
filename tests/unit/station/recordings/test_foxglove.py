"""Exported recordings open in Foxglove's own libraries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from iort_analysis.samples.blocks import Block, column_of
from iort_contract.limits import Value
from iort_contract.messages.message_type import MessageType
from iort_station.data import bags
from iort_station.data.ros_messages import Maker, made_of
from tests.foxglove import flat, opened
from tests.unit.station.recordings.test_messages import RICH, STAMPED

T_US = 1_700_000_000_123_456
COUNT = 2500

RICH_SAMPLE: dict[str, Value] = {
    "on": True, "small": 7, "large": 5, "name": "ü", "at.sec": 5, "at.nanosec": 6,
    "took.sec": -1, "took.nanosec": 2, "pair.0": 0.5, "pair.1": -2.0, "bytes.0": 1, "bytes.1": 255,
    "parts.0.x": 1.25, "parts.1.x": 2.5, "names.0": "a", "names.1": "b",
}  # fmt: skip


def blocks(samples: Sequence[Mapping[str, Value]]) -> list[Block]:
    """The samples, one a millisecond, a few hundred in a block."""
    return [
        Block(
            np.arange(len(samples))[at : at + 700] * 1000 + T_US,
            {name: column_of([sample[name] for sample in samples[at : at + 700]]) for name in samples[0]},
        )
        for at in range(0, len(samples), 700)
    ]


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_foxglove_reads_every_message_of_every_type(tmp_path: Path, suffix: str) -> None:
    stamped = [{"x": i / 7, "code": i} for i in range(COUNT)]
    rich = [{**RICH_SAMPLE, "large": 2**53 + i, "parts.1.x": i / 3, "name": f"ü{i}"} for i in range(COUNT)]
    untyped = [{"rule_ms": None if i % 3 == 0 else i / 9, "pose.x": i} for i in range(COUNT)]
    own = made_of("rtt", blocks(untyped)[0].columns)
    makers = {
        "/stamped": Maker(MessageType("stamped", "/stamped", "a_msgs/S", "", STAMPED), ["x", "code"]),
        "/rich": Maker(MessageType("rich", "/rich", "a_msgs/A", "", RICH), list(rich[0])),
        "/rtt": Maker(own, list(untyped[0]), own=True),
    }
    path = tmp_path / f"ride{suffix}"
    with bags.KINDS[suffix](path) as file:
        for maker, samples in zip(makers.values(), (stamped, rich, untyped), strict=True):
            write = file.topic(maker.kind.topic, maker.kind.kind, maker.definition, maker.md5sum)
            for block in blocks(samples):
                for t_ns, message in maker.messages(block):
                    write(t_ns, message)

    found = opened(path)
    assert found.types == {topic: (maker.kind.kind, maker.md5sum) for topic, maker in makers.items()}
    times = [(T_US + 1000 * i) * 1000 for i in range(COUNT)]
    for topic in makers:
        assert [t_ns for t_ns, _ in found.messages[topic]] == times
    messages = {topic: [message for _, message in found.messages[topic]] for topic in makers}
    assert [message["b"] for message in messages["/stamped"]] == stamped
    headers = [message["header"] for message in messages["/stamped"]]
    assert [header["seq"] for header in headers] == list(range(COUNT))
    assert [header["stamp"]["sec"] * 10**9 + header["stamp"]["nsec"] for header in headers] == times
    assert {header["frame_id"] for header in headers} == {""}
    # JavaScript's 64-bit integers are printed as texts.
    assert [flat(message) for message in messages["/rich"]] == [
        {**sample, "large": str(sample["large"])} for sample in rich
    ]
    # NaN is null in JSON.
    assert [flat(message) for message in messages["/rtt"]] == [
        {"rule_ms": sample["rule_ms"], "pose_x": sample["pose.x"]} for sample in untyped
    ]
