"""What a source says of its topics' frames, and what it does not."""

from __future__ import annotations

import pytest
from device.sources.frames import MAX_CHANGES, Frames

from contract import ContractError, FrameId, frame_id, message_type


def test_a_frame_survives_the_wire_and_a_wrong_one_is_refused() -> None:
    frame = FrameId("scan", "/scan", "laser", 1_700_000_000_000_001)
    assert frame_id(frame.sample()) == frame
    assert frame_id({**frame.sample(), "frame_since_us": float(frame.since_us)}) == frame
    with pytest.raises(ContractError, match="without a text"):
        frame_id({**frame.sample(), "topic": None})
    for wrong in (None, True, "1", 1.5, float("nan"), float("inf")):
        with pytest.raises(ContractError, match="not a number of microseconds"):
            frame_id({**frame.sample(), "frame_since_us": wrong})
    # A station from before frames were said takes it for no type, and goes on.
    with pytest.raises(ContractError, match="without 'kind'"):
        message_type(frame.sample())


def test_a_frame_that_keeps_changing_is_not_known_rather_than_wrong(caplog: pytest.LogCaptureFixture) -> None:
    frames = Frames("s", "/t")
    said = [frames.sample(("map", "odom")[t % 2], t) for t in range(1000)]
    known = [frame_id(sample) for sample in said if sample is not None]
    assert [f.since_us for f in known] == list(range(MAX_CHANGES + 1))
    assert [f.frame_id for f in known[-3:]] == ["map", "odom", ""]
    assert len(caplog.records) == 1


def test_a_text_that_no_sample_may_hold_is_not_said() -> None:
    sample = Frames("s", "/t").sample("x" * 5000, 1)
    assert sample is not None
    assert frame_id(sample).frame_id == ""
