"""The simulated car's camera: what it shows, and its number, which programs read."""

from __future__ import annotations

import math
import threading

import pytest
from av import VideoFrame

from iort_agent.errors import VideoError
from iort_agent.sources.sim import SimConfig, SimSource
from iort_agent.sources.sim.driver import HALL, Circuit, Pose
from iort_agent.video import Encoded, Frame
from iort_agent.video.camera import FIRST_S
from iort_agent.video.capture import make_camera
from iort_agent.video.config import H264, VP8, BitrateConfig, SimCamera, VideoConfig
from iort_agent.video.encoder import make_encoder
from iort_agent.video.pictures import fitted, packed
from iort_agent.video.sim_camera import Hall, HallCamera
from testkit.agent import ManualClock
from testkit.video import counter_of, decoded
from tests.unit.agent.video.test_ros_camera import Waits

CIRCUIT = Circuit(HALL)
START = Pose(CIRCUIT.x_m[0], CIRCUIT.y_m[0], CIRCUIT.heading_rad[0])
NOW_US = 1_700_000_000_123_000


def pose(place: int) -> Pose:
    return Pose(CIRCUIT.x_m[place], CIRCUIT.y_m[place], CIRCUIT.heading_rad[place])


def hall(width: int = 640, height: int = 480) -> Hall:
    return Hall(HALL, 0.33, width, height)


def colours(picture: VideoFrame, x: float, y: float) -> tuple[int, ...]:
    """The picture at a place, in shares of its size."""
    return tuple(
        memoryview(plane)[int(y * plane.height) * plane.line_size + int(x * plane.width)]
        for plane in picture.planes
    )


def test_the_same_pose_and_number_give_the_same_picture() -> None:
    first, again = (packed(hall().draw(START, 7, NOW_US)) for _ in range(2))
    assert first == again
    assert packed(hall().draw(START, 8, NOW_US)) != first
    assert packed(hall().draw(pose(1), 7, NOW_US)) != first


def test_the_walls_are_where_they_belong() -> None:
    picture = hall().draw(START, 1, NOW_US)
    assert colours(picture, 0.5, 0.1)[0] > 150, "air above the walls"
    for side, blue, red in ((0.25, 150, 0), (0.75, 0, 150)):
        seen = {colours(picture, side + i / 200, 0.42)[1:] for i in range(-20, 20)}
        assert any(u >= blue and v >= red for u, v in seen), "blue on the left, orange on the right"
    turned = hall().draw(pose(60)._replace(heading_rad=math.pi), 1, NOW_US)
    assert any(colours(turned, 0.75 + i / 200, 0.42)[1] > 150 for i in range(-20, 20)), "the other way around"


@pytest.mark.parametrize("turned_rad", [-0.6, -0.3, 0.3, 0.6])
def test_the_floor_reaches_the_camera_also_of_a_car_that_turns(turned_rad: float) -> None:
    ground = packed(hall().draw(START._replace(x_m=1e6), 1, NOW_US))[640 * 240]
    for place in range(0, len(CIRCUIT.x_m), 10):
        along = pose(place)
        picture = hall().draw(along._replace(heading_rad=along.heading_rad + turned_rad), 1, NOW_US)
        assert all(colours(picture, i / 20, 0.86)[0] != ground for i in range(1, 20)), place


def test_each_place_of_the_track_looks_its_own_way() -> None:
    one = hall(320, 240)
    seen = {packed(one.draw(pose(place), 1, NOW_US)) for place in range(0, CIRCUIT.steps, 3)}
    assert len(seen) == len(range(0, CIRCUIT.steps, 3)), "motion is visible"


@pytest.mark.parametrize("size_m", [0.33, 0.37, 0.02, 2.5, 20.0])
def test_the_panels_colours_alternate_over_the_start_too(size_m: float) -> None:
    edges = Hall(HALL, size_m, 320, 240)._edges
    assert 4 <= len(edges) <= 400
    assert len(edges) % 2 == 0
    for left, right in edges:
        assert math.dist(left, right) == pytest.approx(2.2, abs=0.05), "the track's width"


@pytest.mark.parametrize("away_m", [5.0, 1e3, 1e6])
def test_a_car_that_left_the_track_still_sees(away_m: float) -> None:
    picture = hall().draw(Pose(away_m, -away_m, 1.0), 3, NOW_US)
    assert counter_of(picture) == 3


@pytest.mark.parametrize("number", [0, 1, 12345, 2**32 - 1])
@pytest.mark.parametrize("size", [(640, 480), (320, 240), (1280, 720), (482, 270)])
def test_the_number_is_in_the_picture(number: int, size: tuple[int, int]) -> None:
    assert counter_of(hall(*size).draw(START, number, NOW_US)) == number


def frames(count: int) -> list[Frame]:
    one, made = hall(), []
    for i in range(count):
        picture = one.draw(pose(i * 5 % CIRCUIT.steps), i + 1, NOW_US + i * 66_667)
        picture.pts = 6000 * i
        made.append(Frame(i + 1, NOW_US, i / 15, picture))
    return made


@pytest.mark.parametrize("codec", [VP8, H264])
def test_the_number_is_read_after_150_kbit_a_second_and_at_half_the_size(codec: str) -> None:
    config = VideoConfig(SimCamera(), codec=codec, bitrate_kbps=BitrateConfig(150, 150))
    encoder = make_encoder(config)
    encoded: list[Encoded] = []
    for frame in frames(90):
        one = encoder.encode(frame)
        encoded += [one] if one is not None else []
    rate_kbps = sum(len(one.data) for one in encoded) * 8 / 1000 / 6
    assert rate_kbps < 200
    pictures = decoded(codec, [one.data for one in encoded])
    assert [counter_of(picture) for picture in pictures] == [one.frame.number for one in encoded]
    halves = [counter_of(fitted(picture, 320, 240)) for picture in pictures]
    assert halves == [one.frame.number for one in encoded]


def test_a_picture_without_a_number_has_none() -> None:
    picture = VideoFrame(640, 480, "yuv420p")
    for level in (0, 60, 128, 255):
        picture.planes[0].update(bytes([level]) * picture.planes[0].buffer_size)
        assert counter_of(picture) is None


class Rig:
    """The camera of a car on a clock that stands still."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock, self.stop = clock, threading.Event()
        self.car = SimSource(SimConfig(), clock)
        config = VideoConfig(SimCamera(), rate_hz=10)
        make = make_camera(config, clock, car=self.car)
        self.camera = make()
        self.camera.open()

    def read(self, number: int) -> Frame:
        frame = self.camera.read(number, self.stop)
        assert frame is not None
        return frame


def test_the_pictures_come_at_their_rate_from_where_the_car_is() -> None:
    rig = Rig(ManualClock())
    assert isinstance(rig.camera, HallCamera)
    rig.car.pose = START
    first = rig.read(1)
    rig.car.pose = pose(40)
    second = rig.read(2)
    assert (counter_of(first.picture), counter_of(second.picture)) == (1, 2)
    assert second.monotonic - first.monotonic == pytest.approx(0.1, abs=0.01)
    assert packed(first.picture)[: 640 * 400] != packed(second.picture)[: 640 * 400]
    rig.clock.advance(5)
    times = [rig.read(number).monotonic for number in (3, 4, 5)]
    assert times[1] - times[0] > 0.04, "those that were missed do not come at once"
    assert times[2] - times[1] == pytest.approx(0.1, abs=0.01)


def test_a_car_that_does_not_begin_is_an_error_and_one_that_does_is_seen() -> None:
    with pytest.raises(VideoError, match=f"has not begun to drive within {FIRST_S:g} s"):
        Rig(ManualClock()).read(1)
    clock = Waits()
    rig = Rig(clock)
    clock.then.append(lambda: setattr(rig.car, "pose", START))
    assert counter_of(rig.read(1).picture) == 1


def test_reading_ends_when_nobody_looks() -> None:
    rig = Rig(ManualClock())
    rig.stop.set()
    assert rig.camera.read(1, rig.stop) is None
    rig.car.pose = START
    assert rig.camera.read(1, rig.stop) is None


def test_the_source_tells_where_the_car_is() -> None:
    clock, stop = ManualClock(), threading.Event()
    car = SimSource(SimConfig(rate_hz=50, duration_s=1), clock)
    poses = []

    def emit(stream: str, t_us: int, values: object, *, more: bool = False) -> float:
        poses.append(car.pose)
        return 0.0

    assert car.pose is None
    car.run(emit, stop)
    assert None not in poses
    assert len(set(poses)) > 10
