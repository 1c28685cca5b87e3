"""What `bench`, `verify` and `tests` share: clients, waiting, fakes, a car, ROS, a bad network."""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
