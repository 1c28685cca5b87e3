"""The whole video of a robot: viewers see its pictures, and know their numbers and ages."""

from __future__ import annotations

import math
import threading

import pytest

from iort_agent.agent import make_status
from iort_agent.metrics import MetricsConfig
from iort_agent.sources.sim import SimConfig
from iort_agent.status import render
from iort_contract.messages.shadow import decode_reported
from testkit.waiting import until
from tests.unit.agent.test_agent import Rig as AgentRig
from tests.unit.agent.video.rig import CONFIG, Looks, Viewer


def test_a_viewer_sees_the_pictures_and_knows_each_ones_number(rig, loop):
    viewer = Viewer(rig, loop).connect()
    seen = viewer.sees(20)
    numbers = [one.number for one in seen]
    assert None not in numbers
    assert numbers == sorted(set(numbers))
    # The receiver counts its timestamps from the first picture.
    marks = {mark.number: mark for mark in viewer.marks.values()}
    known = [one for one in seen if one.number in marks]
    origin = marks[known[0].number].rtp - known[0].rtp
    assert len(known) >= 18
    assert {marks[one.number].rtp - one.rtp for one in known} == {origin}
    captured = {mark.number: mark.captured_us for mark in marks.values()}
    now_us, now = rig.clock.now_us(), rig.clock.monotonic()
    newest = known[-1].number
    assert rig.pictures.age_ms(newest, now) == pytest.approx((now_us - captured[newest]) / 1000, abs=5)
    viewer.ask_clock(7)
    (answer,) = until(lambda: viewer.clocks, "the robot's clock")
    assert answer[0] == 7
    assert now_us <= answer[1] <= rig.clock.now_us()
    viewer.close()


def test_the_whole_agent_shows_the_hall_of_its_simulated_car(loop):
    agent = AgentRig(sources=(SimConfig(),), video=CONFIG, metrics=MetricsConfig(enabled=False))
    run = threading.Thread(target=agent.runtime.run, kwargs={"drain_s": 30.0})
    run.start()
    try:
        viewer = Viewer(Looks(agent.uplink), loop).connect()
        numbers = [one.number for one in viewer.sees(10)]
        assert None not in numbers
        assert numbers == sorted(set(numbers))
        assert agent.agent.pictures.age_ms(numbers[-1], agent.clock.monotonic()) < math.inf
        assert "video     viewers 1, bitrate_kbps" in render(make_status(agent.agent))
        assert decode_reported(agent.agent.shadow._state()).video == CONFIG.terms()
        viewer.close()
    finally:
        agent.runtime.stop()
        run.join()
    frames = [frame for batch in agent.batches("video") for frame in batch.columns["frame"]]
    assert set(numbers) <= set(frames)
