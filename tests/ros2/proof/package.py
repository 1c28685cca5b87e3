"""A lab's own interface package, made where colcon is: what no robot's packages have."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from pathlib import Path

from testkit import ROOT
from testkit.ros2 import Ros2
from tests.ros2.proof.robot import LAB

MESSAGES = {
    "Empties": "Nothing nothing\nNothing[2] two\nNothing[] many\nuint8 one\nNothing last\n",
    "Nothing": "",
    "Limits": """# Every number at its ends, each after one that is smaller: all the padding that there is.
int8 LEAST=-128
string NAME="grün"
int8 a
int64 b
bool c
float64 d
char e
uint16 f
byte g
uint32 h
int16 i
uint64 j 18446744073709551615
float32 k 1.5
int32 l
""",
    "Envelope": """std_msgs/Header header
# Its name is that of a header.
Part stamp
wstring wide "breit"
wstring<=4[<=3] wides
string<=10 brief
string[<=2] few
bool[3] flags
Part[2] pair
Part[<=3] some
Part[] parts
builtin_interfaces/Duration since
uint8[<=7] odd
float64 after
""",
    "Part": "string name\nfloat64[3] at [0.0, 1.0, 2.0]\nuint8 kind 3\nPoint2[<=2] points\n",
    "Point2": "float32 x\nint16 y\n",
}
_MANIFEST = f"""<package format="3"><name>{LAB}</name><version>0.1.0</version>
<description>odd messages</description><maintainer email="lab@example.org">lab</maintainer>
<license>Apache-2.0</license><buildtool_depend>ament_cmake</buildtool_depend>
<buildtool_depend>rosidl_default_generators</buildtool_depend><depend>std_msgs</depend>
<depend>builtin_interfaces</depend><exec_depend>rosidl_default_runtime</exec_depend>
<member_of_group>rosidl_interface_packages</member_of_group>
<export><build_type>ament_cmake</build_type></export></package>
"""
_CMAKE = f"""cmake_minimum_required(VERSION 3.16)
project({LAB})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(std_msgs REQUIRED)
find_package(builtin_interfaces REQUIRED)
rosidl_generate_interfaces(${{PROJECT_NAME}} {" ".join(f'"msg/{name}.msg"' for name in MESSAGES)}
  DEPENDENCIES std_msgs builtin_interfaces)
ament_package()
"""


def built(ros2: Ros2) -> Ros2 | None:
    """Return the ROS 2 with the package in it, made once; None where it cannot be made."""
    colcon = shutil.which("colcon", path=ros2.environment["PATH"])
    if colcon is None:
        return None
    content = "".join([_MANIFEST, _CMAKE, *MESSAGES, *MESSAGES.values()])
    made = ROOT / "build" / f"ros2-{ros2.distribution}-{hashlib.sha256(content.encode()).hexdigest()[:12]}"
    prefix = made / "install"
    if not (made / "ready").exists():
        shutil.rmtree(made, ignore_errors=True)
        (source := made / "src" / LAB / "msg").mkdir(parents=True)
        for name, text in MESSAGES.items():
            (source / f"{name}.msg").write_text(text)
        (source.parent / "package.xml").write_text(_MANIFEST)
        (source.parent / "CMakeLists.txt").write_text(_CMAKE)
        # The generators' modules are colcon's Python's.
        python = Path(colcon).resolve().with_name("python3")
        command = [
            *(colcon, "--log-base", "log", "build", "--base-paths", "src", "--merge-install", "--cmake-args"),
            *("-DBUILD_TESTING=OFF", *([f"-DPython3_EXECUTABLE={python}"] if python.exists() else [])),
        ]
        done = subprocess.run(
            command, cwd=made, env=ros2.environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
        (made / "ready").touch()
    return _overlaid(ros2, prefix)


def _overlaid(ros2: Ros2, prefix: Path) -> Ros2:
    """Return the environment as the package's own set-up makes it."""
    command = ["bash", "-c", 'source "$0" >&2 && env -0', str(prefix / "local_setup.bash")]
    done = subprocess.run(command, env=ros2.environment, capture_output=True, text=True, check=True)
    pairs = (line.partition("=") for line in done.stdout.split("\0") if "=" in line)
    return ros2._replace(environment={**os.environ, **{name: value for name, _, value in pairs}})
