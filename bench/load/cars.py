"""Publishes many simulated cars to PubNub's stand-in, as Lambda 1 does, to measure the page.

python -m bench.load.cars --origin 127.0.0.1:8000 --key K --cars 20"""

from __future__ import annotations

import argparse
import base64
import http
import io
import math
import secrets
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

import urllib3

from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import channel
from iort_contract.limits import Value
from iort_contract.messages.live import LiveSample, live_update
from iort_contract.tables import ROBOT
from iort_station.page.page import PubNubKeys

_WIDTH, _HEIGHT, _HORIZON = 96, 54, 20


def attachment(robot: str, driven_m: float, yaw_rate_rad_s: float) -> dict[str, Value]:
    """A sample of a camera topic with ``large: upload``; the key has the form of the agent's keys."""
    content = _jpeg(driven_m, yaw_rate_rad_s)
    return {
        "format": "jpeg",
        "data.key": f"robots/{robot}/2026/05/04/100000-0123456789abcdef/camera/{driven_m * 1e3:.0f}-data.jpg",
        "data.sha256": "0" * 64,
        "data.size": 60 * len(content),
        "data.content_type": "image/jpeg",
        "data.thumbnail": base64.b64encode(content).decode(),
    }


def _jpeg(driven_m: float, yaw_rate_rad_s: float) -> bytes:
    """A road that bends as the car turns, with a dash that comes nearer as it drives."""
    from PIL import Image, ImageDraw  # noqa: PLC0415 - only the pictures need it

    image = Image.new("RGB", (_WIDTH, _HEIGHT), (176, 196, 212))
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, _HORIZON, _WIDTH, _HEIGHT), fill=(96, 104, 88))
    middle, far = _WIDTH / 2, _WIDTH / 2 + 26 * yaw_rate_rad_s
    draw.polygon([(middle - 43, _HEIGHT), (far - 3, _HORIZON), (far + 3, _HORIZON), (middle + 43, _HEIGHT)])
    near = math.fmod(driven_m, 2) / 2
    y, x = _HORIZON + near * (_HEIGHT - _HORIZON), far + near * (middle - far)
    draw.line((x, y, x, y + 6 * near), fill=(70, 72, 76), width=2)
    out = io.BytesIO()
    image.save(out, "JPEG", quality=80)
    return out.getvalue()


RATE_HZ = 10.0
# Length of a simulation step; with larger ones the driver swerves.
_STEP_S = 0.02
# Hundreds of slow cars would need all of a processor for driving; they drive in slow motion instead.
_MOST_STEPS = 5
# The delays of a real car: before the publish, the sample left the car and reached the cloud this long ago.
_SENT_MS, _RECEIVED_MS, _LAMBDA_MS = 11.0, 7.0, 3.0


class SimulatedCar:
    """A car that drives laps: motor controller and, with ``senses``, pose, accelerations and camera."""

    def __init__(self, name: str, seed: int, *, senses: bool = False) -> None:
        self.name, self.senses = name, senses
        self.fault_code = 0
        self._vehicle = Vehicle(VehicleConfig(), seed)
        self._measured = Sensors(self._vehicle, seed)
        self._gain = VehicleConfig().speed_to_erpm_gain
        self._boot = secrets.token_hex(4)
        self._seqs: dict[str, int] = {}
        self._driven_m = self._speed_mps = 0.0
        for _ in range(seed * 97 % 500):
            self._vehicle.step(_STEP_S)
        self._heading = self._vehicle.pose.heading_rad

    def updates(self, dt: float) -> list[dict[str, Any]]:
        """Drive on for ``dt`` seconds, at most `_MOST_STEPS`; return one live update for each stream."""
        for _ in range(min(_MOST_STEPS, round(dt / _STEP_S))):
            self._vehicle.step(_STEP_S)
        sample = {**self._measured.vesc(), "fault_code": self.fault_code}
        updates = [self._update(VESC_STREAM, sample)]
        if self.senses:
            updates += self._sense(float(sample["speed"] or 0) / self._gain, dt)
        return updates

    def _sense(self, speed_mps: float, dt: float) -> list[dict[str, Any]]:
        self._driven_m += speed_mps * dt
        x_m, y_m, heading = self._vehicle.pose
        yaw_rate = math.remainder(heading - self._heading, 2 * math.pi) / dt
        self._heading = heading
        longitudinal = (speed_mps - self._speed_mps) / dt
        self._speed_mps = speed_mps
        pose: dict[str, Value] = {
            "pose.pose.position.x": round(x_m, 3),
            "pose.pose.position.y": round(y_m, 3),
            "twist.twist.linear.x": round(speed_mps, 3),
            "child_frame_id": "base_link",
        }
        acceleration: dict[str, Value] = {
            "linear_acceleration.x": round(longitudinal, 3),
            "linear_acceleration.y": round(speed_mps * yaw_rate, 3),
            "angular_velocity.z": round(yaw_rate, 3),
        }
        picture = attachment(self.name, self._driven_m, yaw_rate)
        return [
            self._update("odom", pose),
            self._update("imu", acceleration),
            self._update("camera", picture),
        ]

    def _update(self, stream: str, sample: Mapping[str, Value]) -> dict[str, Any]:
        seq = self._seqs[stream] = self._seqs.get(stream, -1) + 1
        now_us = time.time_ns() // 1000
        sent_us = now_us - int(_SENT_MS * 1000)
        live = LiveSample(self._boot, seq, sent_us - 2_000, sent_us, dict(sample), 0, 0)
        received_ms = int(now_us / 1000 - _RECEIVED_MS)
        return live_update(self.name, stream, live, received_ms, now_us - int(_LAMBDA_MS * 1000))


def drive(
    cars: list[SimulatedCar], keys: PubNubKeys, stop: threading.Event, rate_hz: float = RATE_HZ
) -> None:
    """Publish every car at ``rate_hz``, evenly spread, until ``stop`` is set."""
    url = f"http://{keys.origin}/publish/{keys.publish_key}/{keys.subscribe_key}/0"
    pool, began, turn = urllib3.PoolManager(timeout=30), time.monotonic(), 0
    while not stop.is_set():
        for i, car in enumerate(cars):
            due = began + (turn + i / len(cars)) / rate_hz
            if stop.wait(max(0.0, due - time.monotonic())):
                return
            for update in car.updates(1 / rate_hz):
                answer = pool.request("POST", f"{url}/{channel(update[ROBOT])}/0", json=update)
                if answer.status != http.HTTPStatus.OK:
                    raise OSError(f"the stand-in answered {answer.status}")
        turn += 1


def main() -> None:
    """Drive until standard input ends."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--origin", required=True)
    parser.add_argument("--key", required=True, help="to publish, and to subscribe")
    parser.add_argument("--cars", type=int, default=20)
    parser.add_argument("--rate", type=float, default=RATE_HZ, help="Hz, of each car")
    options = parser.parse_args()
    keys = PubNubKeys(publish_key=options.key, subscribe_key=options.key, origin=options.origin, tls=False)
    cars = [SimulatedCar(f"car{i + 1}", i + 1) for i in range(options.cars)]
    stop = threading.Event()
    driving = threading.Thread(target=drive, args=(cars, keys, stop, options.rate))
    driving.start()
    sys.stdin.read()
    stop.set()
    driving.join()


if __name__ == "__main__":
    main()
