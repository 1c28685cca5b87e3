"""What `bench`, `verify` and `tests` share: clients, waiting, fakes, a car, ROS."""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
