"""The processor that a camera's pictures take in the agent, beside ffmpeg encoding the same pictures with the
same settings.

Ours is what the agent does with a picture before viewers get it: drawing it or converting a ROS message, and
encoding, one picture after the other. The floor reads the pictures from a file, as the encoder takes them,
and writes nothing; the processor time of its start is taken off. Both are measured in turns."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import av

from bench.report import Report, Section, ratio
from bench.sections import Declared, Option
from iort_agent.sources.sim import SimConfig
from iort_agent.sources.sim.driver import Circuit, Pose
from iort_agent.video import RTP_HZ, Frame
from iort_agent.video.config import H264, VP8, BitrateConfig, SimCamera, VideoConfig
from iort_agent.video.encoder import LIBRARIES, make_encoder, options
from iort_agent.video.pictures import fitted, packed
from iort_agent.video.ros_camera import images_of
from iort_agent.video.sim_camera import Hall
from iort_contract.ros.definition import RULE
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

WIDTH, HEIGHT, RATES_HZ, KBPS = 640, 480, (15, 30), 1500
# The most that the agent may take: of the encoder alone, and with the camera.
ENCODE_TIMES, WHOLE_TIMES = 1.3, 2.5
_START_US = 1_700_000_000_000_000
_FFMPEG = "ffmpeg"
_IMAGE = f"""std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
{RULE}
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id"""
_HEAD = struct.Struct("<IIII6sIII4sBII")


class Camera(NamedTuple):
    """A camera of the bench: ``picture`` makes one as the agent does."""

    title: str
    picture: Callable[[int], av.VideoFrame]


def hall() -> Camera:
    """The simulated car's camera, on its way around the hall."""
    car = SimConfig()
    circuit = Circuit(car.track)
    drawn = Hall(car.track, car.vehicle.wheelbase_m, WIDTH, HEIGHT)

    def picture(i: int) -> av.VideoFrame:
        place = i * 2 % circuit.steps
        pose = Pose(circuit.x_m[place], circuit.y_m[place], circuit.heading_rad[place])
        frame: av.VideoFrame = drawn.draw(pose, i + 1, _START_US + i * 1_000_000 // 15)
        return frame

    return Camera("the simulated car's camera", picture)


def topic(count: int) -> Camera:
    """A ROS 1 topic of bgr8 images, of ffmpeg's test picture with noise: a camera's pictures have some."""
    messages = []
    with av.open(f"testsrc2=size={WIDTH}x{HEIGHT}:rate=15,noise=alls=12:allf=t", format="lavfi") as source:
        for i, shown in enumerate(source.decode(video=0)):
            if i == count:
                break
            content = bytes(shown.reformat(format="bgr24").planes[0])
            step = len(content) // HEIGHT
            head = (i, 1_700_000_000 + i, 0, 6, b"camera", HEIGHT, WIDTH, 4, b"bgr8", 0, step, len(content))
            messages.append(_HEAD.pack(*head) + content)
    images = images_of("sensor_msgs/Image", _IMAGE)
    return Camera("a ROS 1 topic of bgr8", lambda i: fitted(images.picture(messages[i])[1], WIDTH, HEIGHT))


class Measured(NamedTuple):
    """Milliseconds of the processor a picture, of each round: with the camera, the encoder's, the floor's."""

    whole: list[float]
    encoder: list[float]
    floor: list[float]


def run(_target: Target | None, say: Say, *, pictures: int, rounds: int) -> Section:
    """Measure both cameras with both codecs."""
    program = shutil.which(_FFMPEG)
    floor = "ffmpeg" if program is not None else "PyAV alone"
    report = Section("video", "The processor for video")
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as folder:
        for camera in (hall(), topic(pictures)):
            raw = Path(folder) / "pictures.yuv"
            raw.write_bytes(b"".join(packed(camera.picture(i)) for i in range(pictures)))
            for codec in (VP8, H264):
                for rate_hz in RATES_HZ:
                    say(f"{camera.title}, {codec}, {rate_hz} Hz")
                    measured = Measured([], [], [])
                    for _ in range(rounds):
                        whole, encoder = _ours(camera, codec, rate_hz, pictures)
                        measured.whole.append(whole)
                        measured.encoder.append(encoder)
                        measured.floor.append(_floor(program, raw, codec, rate_hz, pictures))
                    name = f"{camera.title}, {codec}, {rate_hz} Hz"
                    rows.append(_figures(report, name, measured, floor, rate_hz))
    head = [
        "camera, codec, rate",
        "the agent",
        "of it the encoder",
        f"{floor}, same pictures",
        "the agent, of a core",
    ]
    report.table(f"Milliseconds of the processor a picture, {WIDTH}x{HEIGHT} at {KBPS} kbit/s", head, rows)
    if program is None:
        report.notes.append("ffmpeg is not installed (apt install ffmpeg): the floor is PyAV's plain loop.")
    return report


def _figures(section: Section, name: str, ms: Measured, floor: str, rate_hz: int) -> list[str]:
    """Add the ratios of a camera; returns its row of the table."""
    whole, encoder, least = (median(values) for values in ms)
    pairs = [[value] for value in ms.floor]
    section.ratio(f"processor of {name} / {floor}", ratio([[v] for v in ms.whole], pairs), WHOLE_TIMES)
    section.ratio(f"its encoder's / {floor}, {name}", ratio([[v] for v in ms.encoder], pairs), ENCODE_TIMES)
    section.raw[name] = ms._asdict()
    return [name, f"{whole:.2f}", f"{encoder:.2f}", f"{least:.2f}", f"{whole * rate_hz / 10:.1f} %"]


def _ours(camera: Camera, codec: str, rate_hz: int, count: int) -> tuple[float, float]:
    """Milliseconds a picture: all, and the encoder's."""
    config = VideoConfig(
        SimCamera(),
        WIDTH,
        HEIGHT,
        rate_hz=float(rate_hz),
        codec=codec,
        bitrate_kbps=BitrateConfig(KBPS, KBPS),
    )
    encoder, encode_s, began = make_encoder(config), 0.0, time.process_time()
    for i in range(count):
        picture = camera.picture(i)
        picture.pts = i * RTP_HZ // rate_hz
        before = time.process_time()
        encoder.encode(Frame(i + 1, 0, i / rate_hz, picture))
        encode_s += time.process_time() - before
    return (time.process_time() - began) * 1000 / count, encode_s * 1000 / count


def _floor(program: str | None, raw: Path, codec: str, rate_hz: int, count: int) -> float:
    """Milliseconds a picture of ffmpeg, or of PyAV's plain loop."""
    command = _ffmpeg(program, codec, rate_hz) if program is not None else _pyav(codec, rate_hz)
    first, all_ = (_child_s(command(raw, pictures)) for pictures in (1, count))
    return (all_ - first) * 1000 / (count - 1)


def _settings(codec: str) -> dict[str, str]:
    return {**options(codec, KBPS * 1000), "g": "1000000", "b": str(KBPS * 1000)}


def _ffmpeg(program: str, codec: str, rate_hz: int) -> Callable[[Path, int], list[str]]:
    def command(raw: Path, count: int) -> list[str]:
        given = [part for name, value in _settings(codec).items() for part in (f"-{name}:v", value)]
        source = ["-f", "rawvideo", "-pix_fmt", "yuv420p", "-s", f"{WIDTH}x{HEIGHT}", "-r", str(rate_hz)]
        head = [program, "-v", "error", "-nostdin", *source, "-i", str(raw), "-frames:v", str(count)]
        return [*head, "-threads", "1", "-c:v", LIBRARIES[codec], *given, "-f", "null", "-"]

    return command


def _pyav(codec: str, rate_hz: int) -> Callable[[Path, int], list[str]]:
    program = [sys.executable, "-m", "bench.sections.video", codec, str(rate_hz)]
    return lambda raw, count: [*program, str(count), str(raw)]


def encode(codec: str, rate_hz: int, count: int, raw: Path) -> None:
    """Encode raw pictures by PyAV in a plain loop, and write nothing: the floor where ffmpeg is missing."""
    context: Any = av.CodecContext.create(LIBRARIES[codec], "w")
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    context.time_base, context.framerate = Fraction(1, rate_hz), Fraction(rate_hz)
    context.bit_rate, context.gop_size, context.thread_count = KBPS * 1000, 1_000_000, 1
    context.options = options(codec, KBPS * 1000)
    parts = WIDTH * HEIGHT, WIDTH * HEIGHT // 4, WIDTH * HEIGHT // 4
    with raw.open("rb") as pictures:
        for i in range(count):
            picture = av.VideoFrame(WIDTH, HEIGHT, "yuv420p")
            for plane, size in zip(picture.planes, parts, strict=True):
                plane.update(pictures.read(size))
            picture.pts = i
            context.encode(picture)


def _child_s(command: list[str]) -> float:
    """The processor time of a process. Raises `InstrumentError` if it fails."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None, "as above"
    with process.stderr as errors:
        told = errors.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise InstrumentError(f"{' '.join(command)}: {told.strip()}")
    return usage.ru_utime + usage.ru_stime


SECTION = Declared(
    "the processor that a camera's pictures take, beside ffmpeg",
    run,
    (
        Option("PICTURES", int, 300, "pictures of each measurement"),
        Option("ROUNDS", int, 3, "how often each is measured"),
    ),
    Report("video", "The processor for video", "make bench ONLY=video"),
    cloud=False,
)

if __name__ == "__main__":
    encode(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
