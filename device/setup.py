"""The agent as a ROS 2 package, for colcon. pip and uv read pyproject.toml, and nothing here."""

import sys

from setuptools import Distribution, find_packages, setup


class Package(Distribution):
    """Humble's setuptools do not read pyproject.toml, and colcon not what later ones make of it."""

    def parse_config_files(self, *_given: object) -> None:
        super().parse_config_files(["setup.cfg"])


if "setuptools.build_meta" in sys.modules:
    setup()
else:
    setup(
        distclass=Package,
        name="iort-agent",
        version="0.3.0",
        packages=find_packages(include=["iort_agent*"]),
        package_data={"iort_agent": ["py.typed"]},
        data_files=[
            ("share/ament_index/resource_index/packages", ["resource/iort_agent"]),
            ("share/iort_agent", ["package.xml"]),
            ("share/iort_agent/launch", ["launch/agent.launch.py"]),
            ("share/iort-agent", ["systemd/iort-agent.service", "udev/99-vesc.rules"]),
        ],
        entry_points={"console_scripts": ["iort-agent = iort_agent.cli:main"]},
    )
