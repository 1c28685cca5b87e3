"""Pictures as a camera makes them, and a recording of them."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

TOPIC, KIND = "/camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage"
START_NS = 1_600_000_000_000_000_000


def jpeg(seed: int = 0, *, width: int = 640, height: int = 480) -> bytes:
    """Make noise over a gradient, which compresses as badly as a gravel path."""
    noise = np.random.default_rng(seed).integers(0, 120, (height, width, 3), dtype=np.uint8)
    ramp = np.linspace(0, 120, width, dtype=np.uint8)[None, :, None]
    out = io.BytesIO()
    Image.fromarray(noise + ramp).save(out, "JPEG", quality=90)
    return out.getvalue()


def write_bag(path: Path, pictures: list[bytes], *, hz: float = 2.0) -> Path:
    """Write a ROS 1 recording of CompressedImage."""
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    with Writer(path) as writer:
        camera = writer.add_connection(TOPIC, KIND, typestore=store)
        for i, picture in enumerate(pictures):
            at = START_NS + round(i * 1e9 / hz)
            sec, nanosec = divmod(at, 1_000_000_000)
            stamp = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
            message = types[KIND](
                header=types["std_msgs/msg/Header"](seq=i, stamp=stamp, frame_id="camera"),
                format="jpeg",
                data=np.frombuffer(picture, dtype=np.uint8),
            )
            writer.write(camera, at, store.serialize_ros1(message, KIND))
    return path
