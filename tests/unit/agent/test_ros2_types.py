"""The definitions of installed types of ROS 2, from packages that the test makes."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from iort_agent.errors import SourceError
from iort_agent.ros.ros2_types import Types, installed, service
from iort_contract.ros.definition import RULE, parse


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of packages, of which each file of a message makes a class."""

    def share(package: str) -> str:
        if not (tmp_path / package).is_dir():
            raise LookupError(package)
        return str(tmp_path / package)

    index = SimpleNamespace(get_package_share_directory=share)
    monkeypatch.setitem(sys.modules, "ament_index_python", ModuleType("ament_index_python"))
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", index)
    for package in ("a_msgs", "b_msgs"):
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", SimpleNamespace())
    return tmp_path


def message(packages: Path, kind: str, text: str | None, fields: dict[str, str] | None = None) -> None:
    package, name = kind.split("/")
    setattr(
        sys.modules[f"{package}.msg"],
        name,
        SimpleNamespace(get_fields_and_field_types=lambda: fields or {}),
    )
    if text is not None:
        (packages / package / "msg").mkdir(parents=True, exist_ok=True)
        (packages / package / "msg" / f"{name}.msg").write_text(text)


def test_a_definition_has_its_nested_types_once_in_the_order_of_ros2_bag(packages: Path) -> None:
    message(
        packages,
        "a_msgs/A",
        "# a comment\nZ z\nb_msgs/B[<=3] b\nstring<=5 s\nbyte C=1\nM m\nb_msgs/msg/B again\n",
    )
    message(packages, "a_msgs/Z", "M m\n")
    message(packages, "a_msgs/M", "float64 x\n")
    message(packages, "b_msgs/B", "wstring w\n")
    found = installed("a_msgs/msg/A")
    heads = [line for line in found.text.splitlines() if line.startswith("MSG")]
    assert heads == ["MSG: a_msgs/M", "MSG: a_msgs/Z", "MSG: b_msgs/B"]
    assert f"\n{RULE}\nMSG: a_msgs/M\nfloat64 x\n" in found.text
    assert found.text.startswith("# a comment\nZ z\n")
    assert found.type_hash.startswith("sha256_")


def test_the_hash_is_the_distributions_where_it_has_one(packages: Path) -> None:
    message(packages, "a_msgs/A", "float64 x\n")
    hashes = [
        {"type_name": "a_msgs/msg/A", "hash_string": "RIHS01_1"},
        {"type_name": "x", "hash_string": "y"},
    ]
    file = packages / "a_msgs" / "msg" / "A.json"
    file.write_text(json.dumps({"type_description_msg": {}, "type_hashes": hashes}))
    assert installed("a_msgs/msg/A").type_hash == "RIHS01_1"
    for damaged in ("", "[]", '{"type_hashes": 5}', '{"type_hashes": [{}]}'):
        file.write_text(damaged)
        assert installed("a_msgs/msg/A").type_hash.startswith("sha256_")


def test_a_type_that_was_written_in_idl_has_the_definition_of_its_class(packages: Path) -> None:
    fields = {
        "flag": "boolean", "raw": "octet", "f": "float", "d": "double[9]", "s": "string",
        "short": "string<10>", "w": "wstring", "many": "sequence<uint8>", "few": "sequence<int16, 4>",
        "texts": "sequence<string<3>, 2>",
        "b": "b_msgs/B", "bs": "sequence<b_msgs/B>",
    }  # fmt: skip
    message(packages, "a_msgs/A", None, fields)
    message(packages, "b_msgs/B", "int32 i\n")
    text = installed("a_msgs/msg/A").text
    assert text.partition("\n===")[0] == (
        "bool flag\nbyte raw\nfloat32 f\nfloat64[9] d\nstring s\nstring<=10 short\nwstring w\nuint8[] many\n"
        "int16[<=4] few\nstring<=3[<=2] texts\nb_msgs/B b\nb_msgs/B[] bs\n"
    )
    assert [field.name for field in parse("a_msgs/msg/A", text).fields()] == list(fields)


def test_an_empty_type_has_an_empty_definition(packages: Path) -> None:
    message(packages, "a_msgs/Empty", "")
    types = Types()
    assert types.found("a_msgs/msg/Empty").text == ""
    assert types.definition("a_msgs/msg/Empty").fields() == ()


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("a_msgs/A", "a ROS 2 message type is package/msg/Type, got 'a_msgs/A'"),
        ("a_msgs/srv/A", "package/msg/Type"),
        ("a_msgs/msg/Missing", "source the workspace that has its package, a_msgs"),
        ("no_msgs/msg/A", "apt install ros-<distribution>-no-msgs"),
    ],
)
def test_a_type_that_is_not_installed_is_named_with_what_to_do(packages: Path, kind: str, why: str) -> None:
    assert packages.is_dir()
    with pytest.raises(SourceError) as raised:
        installed(kind)
    assert why in str(raised.value)


def test_a_definition_that_cannot_be_read_is_told(packages: Path, caplog: pytest.LogCaptureFixture) -> None:
    message(packages, "a_msgs/A", "float64[99999999] x\n")
    types = Types()
    assert types.parsed("a_msgs/msg/A") is None
    assert "the definition of a_msgs/msg/A cannot be read" in caplog.text
    with pytest.raises(SourceError, match="cannot be read"):
        types.definition("a_msgs/msg/A")


def test_a_type_within_itself_ends(packages: Path) -> None:
    message(packages, "a_msgs/A", "B b\n")
    message(packages, "a_msgs/B", "A a\n")
    assert Types().parsed("a_msgs/msg/A") is None


def test_a_service_is_found_or_named(packages: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "a_msgs.srv", SimpleNamespace(Trigger=5))
    assert packages.is_dir()
    assert service("a_msgs/srv/Trigger") == 5
    with pytest.raises(SourceError, match=r"the ROS type b_msgs/srv/Trigger is not installed"):
        service("b_msgs/srv/Trigger")
