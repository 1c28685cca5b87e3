"""The contract as a ROS 2 package, for colcon. pip and uv read pyproject.toml, and nothing here."""

import sys

from setuptools import Distribution, find_packages, setup


class Package(Distribution):
    """Humble's setuptools do not read pyproject.toml, and colcon not what later ones make of it."""

    def parse_config_files(self, *_given: object) -> None:
        super().parse_config_files([])


if "setuptools.build_meta" in sys.modules:
    setup()
else:
    setup(
        distclass=Package,
        name="iort-contract",
        version="0.3.0",
        packages=find_packages(include=["iort_contract*"]),
        package_data={"iort_contract": ["py.typed"]},
        data_files=[
            ("share/ament_index/resource_index/packages", ["resource/iort_contract"]),
            ("share/iort_contract", ["package.xml"]),
        ],
    )
