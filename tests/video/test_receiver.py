"""The aiortc receiver of the proof: it gives a picture as soon as it is whole, and does not wait for one that
is lost."""

from __future__ import annotations

from aiortc.rtp import RtpPacket

from testkit.video_viewer import Decoded, Prompt

KEY, OTHER = b"\x00", b"\x01"


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def packet(number: int, picture: int, *, last: bool = False, data: bytes = OTHER) -> RtpPacket:
    made = RtpPacket(payload_type=97, sequence_number=number, timestamp=picture * 6000, marker=last)
    made._data = data
    return made


def test_a_picture_is_given_with_its_last_packet() -> None:
    buffer = Prompt()
    assert buffer.add(packet(1, 1, data=b"a")) == (False, None)
    _, frame = buffer.add(packet(2, 1, last=True, data=b"b"))
    assert frame is not None
    assert (frame.data, frame.timestamp) == (b"ab", 6000)


def test_packets_may_come_in_another_order() -> None:
    buffer = Prompt()
    assert buffer.add(packet(1, 1, data=b"a"))[1] is None
    assert buffer.add(packet(3, 1, last=True, data=b"c"))[1] is None
    frame = buffer.add(packet(2, 1, data=b"b"))[1]
    assert frame is not None
    assert frame.data == b"abc"


def test_a_lost_picture_is_waited_for_a_little_and_then_a_key_picture_is_asked_for() -> None:
    clock = Clock()
    buffer = Prompt(clock)
    assert buffer.add(packet(1, 1, last=True))[1] is not None
    # The second picture's first packet is lost.
    assert buffer.add(packet(3, 2, last=True)) == (False, None)
    clock.now += 0.2
    assert buffer.add(packet(4, 3, last=True)) == (False, None)
    clock.now += 0.2
    assert buffer.add(packet(5, 4, last=True)) == (True, None)
    # Those that came before it stay lost.
    clock.now += 0.4
    frame = buffer.add(packet(6, 5, last=True, data=KEY))[1]
    assert frame is not None
    assert frame.timestamp == 5 * 6000
    after = buffer.add(packet(7, 6, last=True))[1]
    assert after is not None
    assert after.timestamp == 6 * 6000


def test_a_picture_that_comes_again_in_time_is_not_lost() -> None:
    clock = Clock()
    buffer = Prompt(clock)
    assert buffer.add(packet(1, 1, last=True))[1] is not None
    assert buffer.add(packet(3, 2, last=True))[1] is None
    clock.now += 0.2
    frame = buffer.add(packet(2, 2, data=b"a"))[1]
    assert frame is not None
    assert frame.data == b"a" + OTHER


def test_pictures_that_waited_behind_a_hole_are_decoded_at_once() -> None:
    buffer = Prompt()
    decoded = Decoded(buffer)
    assert buffer.add(packet(1, 1, last=True))[1] is not None
    for number in range(3, 10):
        assert buffer.add(packet(number, number, last=True))[1] is None
    decoded.put(("vp8", buffer.add(packet(2, 2, last=True))[1]))
    given = [decoded.get_nowait() for _ in range(decoded.qsize())]
    assert [(codec, frame.timestamp) for codec, frame in given] == [("vp8", n * 6000) for n in range(2, 10)]
    # The next one waits for nothing.
    assert buffer.add(packet(10, 10, last=True))[1] is not None
    decoded.put(None)
    assert decoded.get_nowait() is None
