"""What the demo's car is told."""

from __future__ import annotations

from pathlib import Path

from iort_agent.common.schema import Place
from iort_agent.video.config import SimCamera, VideoConfig, video_rule
from local.demo import _camera


def test_the_demos_car_has_a_camera() -> None:
    config = video_rule()(_camera()["video"], Place(Path("car.yaml"), "video"))
    assert config == VideoConfig(SimCamera())
