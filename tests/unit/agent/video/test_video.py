"""The whole video of a robot: viewers see its pictures, and know their numbers and ages."""

from __future__ import annotations

import asyncio
import io
import math
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import replace

import pytest
from aiortc.rtcsctptransport import SCTP_DATA_FIRST_FRAG, SCTP_DATA_UNORDERED, DataChunk
from PIL import Image

from iort_agent.agent import make_status
from iort_agent.common.threads import WATCH, SystemClock
from iort_agent.errors import VideoError
from iort_agent.metrics import MetricsConfig
from iort_agent.ros.json_message import decode
from iort_agent.sources import FAIL, OK
from iort_agent.sources.sim import SimConfig
from iort_agent.status import render
from iort_agent.verbs.check import _video
from iort_agent.video import Frame
from iort_agent.video import video as module
from iort_agent.video.encoder import make_encoder
from iort_agent.video.kept import keeper
from iort_agent.video.sessions import MAX_GARBAGE, MESSAGES_PER_S
from iort_agent.video.signalling import OFFERS_PER_S
from iort_agent.video.video import KEY_EVERY_S
from iort_contract.counter import read_counter
from iort_contract.messages.shadow import decode_reported
from iort_contract.messages.video import (
    ANSWER,
    ASK,
    END,
    ENDED,
    OFFER,
    PICTURES,
    REFUSED,
    TERMS,
    decode_picture,
)
from iort_contract.ros.decode import Decoder, stamp_ns
from iort_contract.ros.definition import parse
from testkit.waiting import GUARD_S, until
from tests.unit.agent.test_agent import Rig as AgentRig
from tests.unit.agent.video.rig import CONFIG, HEIGHT, WIDTH, Looks, Viewer, drawn, instant


def test_a_viewer_sees_the_pictures_and_knows_each_ones_number(rig, loop):
    viewer = Viewer(rig, loop).connect()
    # The channel may open after the first picture.
    until(lambda: viewer.marks, "the first marks")
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
    now_us, now = instant(rig.clock)
    newest = known[-1].number
    # A session reads its two clocks one after the other.
    assert rig.pictures.age_ms(newest, now) == pytest.approx((now_us - captured[newest]) / 1000, abs=200)
    viewer.ask_clock(7)
    (answer,) = until(lambda: viewer.clocks, "the robot's clock")
    assert answer == (7, pytest.approx(now_us, abs=GUARD_S * 1e6))
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


def test_nobody_looks_and_nothing_is_captured_encoded_or_sent(rig, loop):
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    rig.look(viewer.name, END)
    until(lambda: rig.camera.closed == 1, "the camera's end")
    assert rig.video.report()["open"] is False
    assert "encoder" not in rig.video.report()
    taken = rig.video.report()["captured"]
    # Numbers go on in the same run.
    again = Viewer(rig, loop).connect()
    assert again.sees()[0].number > taken
    assert rig.camera.opened == 2


def test_an_agent_that_nobody_looks_at_has_not_loaded_webrtc():
    program = """
import sys
from iort_agent.ros.json_message import decode
from iort_agent.sources.sim import SimConfig
from iort_agent.video.config import SimCamera, VideoConfig
from tests.unit.agent.test_agent import Rig
rig = Rig(sources=(SimConfig(),), video=VideoConfig(SimCamera()))
rig.agent.video.start()
rig.agent.video.close()
print([name for name in ("aiortc", "av", "PIL") if name in sys.modules])
"""
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert output.stdout.strip() == "[]"


def numbers_of(viewer):
    return {one.number for one in list(viewer.seen)}


def test_each_viewer_begins_with_a_key_picture_and_all_share_one_encoder(rig, loop):
    first = Viewer(rig, loop).connect()
    first.sees(5)
    second = Viewer(rig, loop).connect()
    second.sees(5)
    until(lambda: len(numbers_of(first) & numbers_of(second)) >= 4, "pictures that both see")
    assert None not in numbers_of(first) | numbers_of(second)
    samples = [values for _, values in rig.samples]
    assert len({values["frame"] for values in samples}) == len(samples)
    assert {values["viewers"] for values in samples} == {1, 2}


def test_a_viewer_that_lost_pictures_gets_a_key_picture(rig, loop):
    viewer = Viewer(rig, loop).connect()
    viewer.sees(3)
    (session,) = rig.video._signalling.sessions()
    # As if the sender had not taken one in time.
    before = session.skipped
    rig.video._signalling.post(session.missed)
    viewer.sees(10)
    assert session.skipped > before
    assert None not in [one.number for one in viewer.seen]


def test_a_viewer_with_h264_sees_the_pictures(make_rig, loop):
    rig = make_rig(codec="h264")
    viewer = Viewer(rig, loop).connect()
    assert None not in [one.number for one in viewer.sees(5)]


def test_garbage_on_the_data_channel_is_counted_and_bounded(rig, loop):
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    (session,) = rig.video._signalling.sessions()
    for message in (b"", b"\x02", "text", b"x" * 60_000, b"\x03" * 13):
        viewer.send(message)
    until(lambda: session.garbage >= 4, "the garbage")
    viewer.ask_clock(1)
    until(lambda: viewer.clocks, "the robot's clock")
    viewer.sees()
    for i in range(MAX_GARBAGE + 10 * MESSAGES_PER_S):
        viewer.ask_clock(i)
    ended = until(
        lambda: next((show for show in rig.shows[viewer.name] if show.kind == ENDED), None), "the end"
    )
    assert ended.why == "too many messages that are no questions for the clock"
    until(lambda: rig.video.report()["viewers"] == 0, "the session's end")


def test_viewers_who_leave_while_they_connect_leave_nothing(rig, loop):
    # So many offers the robot takes at once.
    for _ in range(int(OFFERS_PER_S)):
        viewer = Viewer(rig, loop).connect()
        rig.look(viewer.name, END)
        viewer.close()
    signalling = rig.video._signalling
    # Whoever is answered now came after them.
    assert rig.ask(rig.name(), ASK).kind == TERMS
    until(lambda: not signalling._closing, "the sessions' end")

    def checks():
        tasks = asyncio.all_tasks(signalling._loop)
        return [task for task in tasks if task.get_coro().__qualname__ == "Connection.query_consent"]

    # Those that were cancelled last end with the loop's next turn.
    until(lambda: not checks(), "the end of the connections' checks")


def end_of(rig, viewer):
    """Wait until the robot has ended a viewer's session; the reason."""
    shows = rig.shows[viewer.name]
    return until(lambda: next((show.why for show in shows if show.kind == ENDED), None), "the end")


def test_many_data_channels_end_the_session(rig, loop):
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    for i in range(MAX_GARBAGE):
        loop.loop.call_soon_threadsafe(viewer.peer.createDataChannel, f"files {i}")
    assert end_of(rig, viewer) == "too many messages that are no questions for the clock"


@pytest.mark.parametrize("flags", [SCTP_DATA_FIRST_FRAG, SCTP_DATA_UNORDERED])
def test_a_message_without_an_end_ends_the_session(rig, loop, flags):
    viewer = Viewer(rig, loop).connect()
    until(lambda: viewer.channel.readyState == "open", "the channel")

    async def flood():
        sctp = viewer.peer.sctp
        while not any(show.kind == ENDED for show in rig.shows[viewer.name]):
            # The robot takes them in another thread.
            await asyncio.sleep(0.001)
            chunk = DataChunk()
            chunk.flags, chunk.stream_id, chunk.stream_seq, chunk.protocol = flags, 1, 0, 53
            chunk.tsn, chunk.user_data = sctp._local_tsn, b"x"
            sctp._local_tsn = (sctp._local_tsn + 1) & 0xFFFFFFFF
            with suppress(ConnectionError):
                await sctp._send_chunk(chunk)

    loop.do(flood())
    assert end_of(rig, viewer) == "messages that never end"
    # Nobody else is harmed.
    Viewer(rig, loop).connect().sees()


def test_a_clock_that_is_set_makes_no_picture_younger(make_rig, loop):
    class Set(SystemClock):
        ahead_us = 0

        def now_us(self):
            return super().now_us() + self.ahead_us

    clock = Set()
    rig = make_rig(clock=clock)
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    viewer.ask_clock(1)
    until(lambda: len(viewer.clocks) == 1, "the robot's clock")
    clock.ahead_us = 3_600_000_000
    seen = viewer.sees(5)
    newest = max(viewer.marks.values())
    assert newest.number >= seen[0].number
    viewer.ask_clock(2)
    until(lambda: len(viewer.clocks) == 2, "the robot's clock")
    first_us, then_us = (us for _, us in viewer.clocks)
    assert first_us < newest.captured_us <= then_us < first_us + clock.ahead_us
    # What is recorded has the robot's time.
    assert max(t_us for t_us, _ in rig.samples) >= first_us + clock.ahead_us


def test_a_data_channel_of_another_name_is_closed(rig, loop):
    viewer = Viewer(rig, loop, channel="files").connect()
    viewer.sees(3)
    until(lambda: viewer.channel.readyState == "closed", "the channel's end")
    assert not viewer.marks


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda sdp: "v=0\r\nm=video 9 UDP/TLS/RTP/SAVPF 96\r\n", "the offer cannot be answered"),
        (lambda sdp: sdp.replace("a=recvonly", "a=sendonly"), "the offer does not receive a video"),
        (lambda sdp: sdp.replace("VP8", "XYZ"), "the offer cannot be answered"),
        (lambda sdp: sdp.replace("a=ice-ufrag", "a=ice-xfrag"), "the offer cannot be answered"),
        (lambda sdp: sdp.replace("m=video ", "m=video x"), "the offer cannot be answered"),
        (lambda sdp: sdp.replace("a=setup:actpass", "a=setup:perhaps"), "the offer cannot be answered"),
    ],
)
def test_a_bad_offer_is_refused_with_the_reason(rig, loop, change, why):
    viewer = Viewer(rig, loop)
    request = rig.look(viewer.name, OFFER, sdp=change(viewer.sdp))
    shows = rig.shows[viewer.name]
    refused = until(lambda: next((s for s in shows if s.kind in (REFUSED, ENDED)), None), "the refusal")
    assert refused.request == request
    assert refused.why.startswith(why)
    until(lambda: rig.video.report()["viewers"] == 0, "no session")
    assert not WATCH.alarms()


def test_without_webrtc_all_watchers_share_small_pictures_over_the_broker(make_rig):
    rig = make_rig(pictures_hz=5.0)
    watchers = [rig.name(), rig.name()]
    for watcher in watchers:
        assert rig.ask(watcher, PICTURES).kind == TERMS
    until(lambda: len(rig.over_broker) >= 6, "pictures")
    pictures = [decode_picture(payload) for payload in rig.over_broker]
    numbers = [picture.number for picture in pictures]
    assert numbers == sorted(set(numbers))
    # Five a second, one message for both.
    assert len(numbers) < rig.video.report()["captured"]
    for picture in pictures:
        assert rig.pictures.age_ms(picture.number, rig.clock.monotonic()) > 0
        image = Image.open(io.BytesIO(picture.jpeg)).convert("L")
        assert read_counter(lambda x, y, image=image: image.getpixel((x, y)), *image.size) == picture.number
    assert {values["watchers"] for _, values in rig.samples} <= {1, 2}
    assert [values["frame"] for _, values in rig.samples][: len(numbers)] == numbers[: len(rig.samples)]
    assert "encoder" not in rig.video.report()


def test_a_camera_that_fails_is_told_to_viewers_and_to_those_who_come(rig, loop, monkeypatch):
    monkeypatch.setattr(module, "AGAIN_S", GUARD_S)
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    rig.camera.error = VideoError("/dev/video0: unplugged")
    ended = until(lambda: next((s for s in rig.shows[viewer.name] if s.kind == ENDED), None), "the end")
    assert ended.why == "the camera does not work: /dev/video0: unplugged"
    assert rig.ask(rig.name(), ASK).why == "the camera does not work: /dev/video0: unplugged"
    until(lambda: any("unplugged" in alarm for alarm in WATCH.alarms()), "the alarm")


def test_a_camera_thread_that_fails_goes_on_for_the_same_viewers(rig, loop):
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    rig.camera.once = RuntimeError("of a kind that nobody handles")
    until(lambda: [alarm for alarm in WATCH.alarms() if "the thread camera" in alarm], "the alarm")
    newest = rig.video.report()["captured"]
    until(lambda: (viewer.seen[-1].number or 0) > newest, "newer pictures")
    assert [show.kind for show in rig.shows[viewer.name]] == [ANSWER]


def test_a_camera_that_fails_in_any_way_is_told_to_viewers(rig, loop):
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    rig.camera.error = KeyError("width")
    assert end_of(rig, viewer) == "the camera does not work: KeyError: 'width'"


def test_an_encoder_that_fails_is_told_to_viewers(make_rig, loop):
    def fail(config):
        raise MemoryError("no room")

    rig = make_rig(encoder=fail)
    viewer = Viewer(rig, loop).connect()
    assert end_of(rig, viewer) == "the camera does not work: MemoryError: no room"


def test_a_picture_that_the_thread_did_not_take_blocks_no_later_one(rig, loop):
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    signalling = rig.video._signalling
    # As between two runs of the thread.
    running, signalling._loop = signalling._loop, None
    until(lambda: rig.video._handed, "a picture")
    signalling._loop = running
    viewer.sees(3)


def test_without_pillow_viewers_are_told_what_to_install(rig, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    refused = rig.ask(rig.name(), PICTURES)
    assert refused.kind == REFUSED
    assert "needs the package pillow: pip install 'iort-agent[video]'" in refused.why
    assert rig.camera.opened == 0


def test_a_thread_that_hangs_does_not_keep_the_agent_from_ending(make_rig, monkeypatch, caplog):
    monkeypatch.setattr(module, "END_S", 0.1)
    rig, hangs = make_rig(), threading.Event()
    assert rig.ask(rig.name(), ASK).kind == TERMS
    rig.video._signalling.post(hangs.wait)
    try:
        rig.video.close()
        assert "its thread does not end" in caplog.text
    finally:
        hangs.set()


@pytest.mark.parametrize("error", [SystemExit("killed"), ValueError("a mistake")])
def test_a_killed_thread_ends_the_sessions_and_new_ones_begin(rig, loop, error):
    viewer = Viewer(rig, loop).connect()
    viewer.sees()

    def die():
        raise error

    rig.video._signalling.post(die)
    until(lambda: [alarm for alarm in WATCH.alarms() if "the thread video" in alarm], "the alarm")
    until(lambda: rig.camera.closed == 1, "the camera's end")
    # No newer numbers: whoever drives by sight drives no longer.
    newest = rig.video.report()["captured"]
    assert rig.pictures.age_ms(newest + 1, rig.clock.monotonic()) is None
    assert Viewer(rig, loop).connect().sees()[0].number > newest


def test_the_recorder_keeps_the_pictures_that_were_shown(rig, loop):
    Viewer(rig, loop).connect().sees(5)
    shown = [values["frame"] for _, values in rig.samples]
    assert rig.kept[: len(shown)] == shown


class NeverKey:
    """An encoder that notes when a key picture is asked for, and makes none once it ``withholds`` them."""

    def __init__(self, config):
        self.inner, self.asked, self.count, self.withholds = make_encoder(config), [], 0, False

    def set_bitrate(self, kbps):
        self.inner.set_bitrate(kbps)

    def encode(self, frame, *, key=False):
        self.count += 1
        if key:
            self.asked.append(frame.monotonic)
        return self.inner.encode(frame, key=key and not self.withholds)

    def report(self):
        return {}

    def close(self):
        self.inner.close()


def test_key_pictures_are_asked_for_twice_a_second_at_most(make_rig, loop):
    encoders = []

    def make(config):
        encoders.append(NeverKey(config))
        return encoders[-1]

    rig = make_rig(encoder=make)
    Viewer(rig, loop).connect().sees()
    (session,) = rig.video._signalling.sessions()
    (encoder,) = encoders
    encoder.withholds = True
    rig.video._signalling.post(session.missed)
    before = len(encoder.asked)
    # It asks at each picture, since none is a key picture.
    until(lambda: len(encoder.asked) >= before + 3, "requests for key pictures")
    assert all(later - earlier >= KEY_EVERY_S for earlier, later in zip(encoder.asked, encoder.asked[1:]))
    assert session.skipped >= 3


def test_a_viewer_that_vanishes_is_closed(rig, loop):
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    viewer.close()
    until(lambda: rig.video.report()["viewers"] == 0, "the session's end")
    until(lambda: rig.camera.closed == 1, "the camera's end")


def test_pictures_go_on_while_the_broker_is_away(rig, loop):
    viewer = Viewer(rig, loop).connect()
    viewer.sees()
    rig.uplink.cut()
    viewer.sees(10)
    rig.uplink.connect()
    viewer.keep()
    viewer.sees(10)


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("own", [None, b"\xff\xd8 of the camera"])
def test_a_kept_picture_is_a_compressed_image_of_either_ros(ros, own):
    kept = []
    captured_us = 1_764_329_368_123_456
    keep = keeper(lambda *message: kept.append(message), ros)
    keep(Frame(7, captured_us, 0.0, drawn(7), own))
    ((stream, t_us, message),) = kept
    assert (stream, t_us) == ("pictures", captured_us)
    sample = Decoder(parse(message.kind.name, message.kind.definition), large=True).decode(message.raw)
    assert stamp_ns(message.raw, ros2=ros == 2) == captured_us * 1000
    header = decode(parse(message.kind.name, message.kind.definition), message.raw)["header"]
    assert (header["frame_id"], sample["format"]) == ("7", "jpeg")
    if own is not None:
        assert bytes(sample["data"]) == own
    else:
        image = Image.open(io.BytesIO(sample["data"])).convert("L")
        assert image.size == (WIDTH, HEIGHT)
        assert read_counter(lambda x, y: image.getpixel((x, y)), *image.size) == 7
    # ROS knows a type by this.
    assert message.kind.md5sum == ("8f7a12909da2c9d3332d540a0977563f" if ros == 1 else "")


def test_the_check_tells_what_the_running_agents_camera_does():
    rig = AgentRig(sources=(SimConfig(),), video=CONFIG)
    running = make_status(rig.agent)

    def camera(**changes):
        finding = list(_video(rig.agent.config, replace(running, **changes)))[-1]
        return finding.level, finding.text

    assert camera() == (OK, "nobody looks, so it is closed")
    looked = {"open": True, "viewers": 2, "watchers": 1, "bitrate_kbps": 640}
    assert camera(video=looked) == (OK, "2 viewer(s) at 640 kbit/s, 1 of pictures over the broker")
    alarm = "the thread camera failed and starts again: 1 time(s): VideoError: /dev/video0: unplugged"
    assert camera(alarms=[alarm, "source failed: vesc"]) == (FAIL, alarm)
    assert list(_video(replace(rig.agent.config, video=None), running)) == []
