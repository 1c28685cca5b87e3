"""The camera of the simulated car: the hall as it is seen from the car's pose.

The walls along the track are panels of two colours, blue and white on the left, orange and white on the
right; the floor has bands across the track, so that motion is visible. The same pose, number and time always
give the same picture. At the lower edge is the picture's number for programs (`iort_contract.counter`), above
it the number and the time for people."""

from __future__ import annotations

import math
import threading
import time
from typing import Any, NamedTuple, Sequence

from iort_agent.common.threads import Clock
from iort_agent.errors import VideoError
from iort_agent.sources.sim import SimSource
from iort_agent.sources.sim.driver import Pose
from iort_agent.video import Frame, require
from iort_agent.video.camera import FIRST_S, Camera, Pacer, moment
from iort_agent.video.config import VideoConfig
from iort_agent.video.pictures import from_planes
from iort_contract.counter import COLUMNS, HEIGHTS, ROWS, counter_bits
from iort_contract.track import Track

# In wheelbases: a panel's length, the camera's height, the walls' height, the camera's place before the rear
# axle, and how far it sees.
_PANEL, _HEIGHT, _WALL, _AHEAD, _SIGHT = 1.5, 0.6, 1.1, 1.0, 80.0
_MOST_PANELS = 400
# What is nearer than this is cut off, in wheelbases.
_NEAR = 0.15
# How soon a car that begins to drive is seen.
_LOOK_S = 0.1
# The horizon's place from above, in heights of the picture.
_HORIZON = 0.4


class _Colour(NamedTuple):
    y: int
    u: int = 128
    v: int = 128


# The picture is drawn with these numbers for its colours, which costs a third of drawing red, green and blue.
_AIR, _GROUND, _BAND, _OTHER, _START, _BLACK, _WHITE = range(7)
_COLOURS = [
    _Colour(190, 134, 124),
    _Colour(70, 122, 124),
    _Colour(105),
    _Colour(135),
    _Colour(225),
    _Colour(16),
    _Colour(235),
]
# Left and right walls, each with two colours, each in so many shades: what is far is darker.
_SHADES, _SHADE_M = 4, 12.0
_WALLS = len(_COLOURS)
for _bright, _u, _v in ((130, 175, 105), (215, 128, 128), (150, 85, 180), (215, 128, 128)):
    _COLOURS += [_Colour(round(_bright * (1 - 0.13 * shade)), _u, _v) for shade in range(_SHADES)]


class _Edge(NamedTuple):
    """An end of a panel: points on the floor at the left and the right wall."""

    left: tuple[float, float]
    right: tuple[float, float]


class Hall:
    """Draws a track's hall; ``size_m`` is the car's wheelbase."""

    def __init__(self, track: Track, size_m: float, width: int, height: int) -> None:
        self._image, draw = require("PIL.Image"), require("PIL.ImageDraw")
        self._draw, self._size_m, self._width, self._height = draw, size_m, width, height
        self._edges = _edges(track, size_m)
        self._font = require("PIL.ImageFont").load_default()
        luts = [[colour[i] for colour in _COLOURS] for i in range(3)]
        self._luts = [lut + [0] * (256 - len(lut)) for lut in luts]

    def draw(self, pose: Pose, number: int, captured_us: int) -> Any:
        """The picture, as a frame of yuv420p."""
        image = self._image.new("L", (self._width, self._height), _AIR)
        pen = self._draw.Draw(image)
        pen.fontmode = "1"
        horizon = self._height * _HORIZON
        pen.rectangle((0, horizon, self._width, self._height), fill=_GROUND)
        for points, colour in self._polygons(pose, horizon):
            pen.polygon(points, fill=colour)
        self._number(pen, number, captured_us)
        half = image.resize((self._width // 2, self._height // 2), self._image.NEAREST)
        y, u, v = (one.point(lut) for one, lut in zip((image, half, half), self._luts))
        return from_planes(self._width, self._height, y, u, v)

    def _polygons(self, pose: Pose, horizon: float) -> list[tuple[list[tuple[float, float]], int]]:
        """The floor, and then the walls from far to near: what is drawn last is in front."""
        cos, sin, size = math.cos(pose.heading_rad), math.sin(pose.heading_rad), self._size_m
        x0, y0 = pose.x_m + _AHEAD * size * cos, pose.y_m + _AHEAD * size * sin
        near, far, middle = _NEAR * size, _SIGHT * size, self._width / 2
        floor, top = middle * _HEIGHT * size, middle * (_HEIGHT - _WALL) * size
        # Every point as (ahead, left) of the camera.
        seen = [
            tuple(((x - x0) * cos + (y - y0) * sin, (y - y0) * cos - (x - x0) * sin) for x, y in edge)
            for edge in self._edges
        ]
        bands, walls = [], []
        for i, (left, right) in enumerate(seen):
            next_left, next_right = seen[i + 1 - len(seen)]
            for side, (a, b) in enumerate(((left, next_left), (right, next_right))):
                panel = _before([a, b], near)
                if not panel:
                    continue
                (a0, a1), (b0, b1) = panel[:2]
                # Both ends are to the same side of what the camera sees: a quarter of the circle.
                if min(a0, b0) > far or (a1 > a0 and b1 > b0) or (-a1 > a0 and -b1 > b0):
                    continue
                shade = min(_SHADES - 1, int((a0 + b0) / 2 / size * 0.33 / _SHADE_M * _SHADES))
                ua, ub = middle - middle * a1 / a0, middle - middle * b1 / b0
                quad = [
                    (ua, horizon + floor / a0),
                    (ub, horizon + floor / b0),
                    (ub, horizon + top / b0),
                    (ua, horizon + top / a0),
                ]
                walls.append((a0 + b0, quad, _WALLS + (2 * side + i % 2) * _SHADES + shade))
            points = _before([left, next_left, next_right, right], near)
            if points and min(ahead for ahead, _ in points) < far:
                colour = _START if i == 0 else _BAND if i % 2 else _OTHER
                bands.append(
                    (
                        [(middle - middle * left / ahead, horizon + floor / ahead) for ahead, left in points],
                        colour,
                    )
                )
        walls.sort(key=lambda wall: -wall[0])
        return [*bands, *((quad, colour) for _, quad, colour in walls)]

    def _number(self, pen: Any, number: int, captured_us: int) -> None:
        width, height = self._width / COLUMNS, self._height / HEIGHTS
        top = self._height - ROWS * height
        pen.rectangle((0, top, self._width, self._height), fill=_BLACK)
        for i, bit in enumerate(counter_bits(number & 0xFFFFFFFF)):
            if bit:
                row, column = divmod(i, COLUMNS)
                x, y = column * width, top + row * height
                pen.rectangle((round(x), round(y), round(x + width) - 1, round(y + height) - 1), fill=_WHITE)
        seconds, us = divmod(captured_us, 1_000_000)
        text = f"{number}  {time.strftime('%H:%M:%S', time.gmtime(seconds))}.{us // 1000:03d}Z"
        pen.rectangle((0, top - 16, 8 + 7 * len(text), top - 1), fill=_BLACK)
        pen.text((4, top - 15), text, fill=_WHITE, font=self._font)


def _before(corners: Sequence[tuple[float, float]], near: float) -> list[tuple[float, float]]:
    """The part of a polygon, or of a line, that is before the camera; its points are (ahead, left)."""
    points = []
    for a, b in zip(corners, (*corners[1:], corners[0])):
        if a[0] >= near:
            points.append(a)
        if (a[0] < near) != (b[0] < near):
            share = (near - a[0]) / (b[0] - a[0])
            points.append((near, a[1] + share * (b[1] - a[1])))
    return points


def _edges(track: Track, size_m: float) -> list[_Edge]:
    """The ends of the panels, one after the other around the track."""
    n = len(track.x_m)
    lengths = [
        math.hypot(track.x_m[(i + 1) % n] - track.x_m[i], track.y_m[(i + 1) % n] - track.y_m[i])
        for i in range(n)
    ]
    # An even number, so that the colours alternate over the start, too.
    panels = min(_MOST_PANELS, max(4, round(sum(lengths) / (_PANEL * size_m)))) // 2 * 2
    edges, i, passed = [], 0, 0.0
    for k in range(panels):
        at = k * sum(lengths) / panels
        while i < n - 1 and passed + lengths[i] < at:
            passed += lengths[i]
            i += 1
        j, share = (i + 1) % n, (at - passed) / lengths[i] if lengths[i] else 0.0
        x, y, right, left = (
            column[i] + (column[j] - column[i]) * share
            for column in (track.x_m, track.y_m, track.w_right_m, track.w_left_m)
        )
        heading = math.atan2(track.y_m[j] - track.y_m[i - 1], track.x_m[j] - track.x_m[i - 1])
        sin, cos = math.sin(heading), math.cos(heading)
        edges.append(_Edge((x - left * sin, y + left * cos), (x + right * sin, y - right * cos)))
    return edges


class HallCamera(Camera):
    """The camera of a simulated car. Raises `VideoError` without Pillow or PyAV."""

    def __init__(self, car: SimSource, config: VideoConfig, clock: Clock) -> None:
        self._car, self._clock, self._pacer = car, clock, Pacer(config.rate_hz)
        size_m = car.config.vehicle.wheelbase_m
        self._hall = Hall(car.config.track, size_m, config.width, config.height)

    def open(self) -> None:
        pass

    def read(self, number: int, stop: threading.Event) -> Frame | None:
        began = self._clock.monotonic()
        while (pose := self._car.pose) is None:
            if self._clock.monotonic() - began > FIRST_S:
                raise VideoError(f"the simulated car has not begun to drive within {FIRST_S:g} s")
            if self._clock.wait(stop, _LOOK_S):
                return None
        if self._clock.wait(stop, self._pacer.left_s(self._clock.monotonic())):
            return None
        now, pose = moment(self._clock), self._car.pose or pose
        self._pacer.takes(now.monotonic)
        picture = self._hall.draw(pose, number, now.us)
        return Frame(number, now.us, now.monotonic, picture)

    def close(self) -> None:
        pass
