"""The kept assembly is reused until any of its inputs changes."""

from __future__ import annotations

import pytest

from local import deployment
from local.emulator import package


@pytest.fixture
def checkout(tmp_path):
    for name in deployment._MADE_OF:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    for name in deployment._MADE_OF_FOLDERS:
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "one.py").write_text("1")
    return tmp_path


@pytest.fixture
def assembly(checkout):
    made = []

    def synthesize(output):
        output.mkdir()
        (output / "manifest.json").write_text(str(len(made)))
        made.append(output)

    def get(namespace="iort"):
        folder = deployment.assembly(checkout, checkout / "build", settings=namespace, synthesize=synthesize)
        assert (folder / "manifest.json").exists()
        return len(made)

    return get


def test_unchanged_inputs_are_not_synthesized_again(assembly):
    assert [assembly(), assembly(), assembly()] == [1, 1, 1]


@pytest.mark.parametrize(
    "changed", ["app.py", "contract/iort_contract/one.py", "cdk.json", "stacks/one.py", "functions/one.py"]
)
def test_any_changed_file_is_synthesized_again(assembly, checkout, changed):
    assembly()
    (checkout / changed).write_text("changed")
    assert assembly() == 2


def test_a_new_file_or_namespace_is_synthesized(assembly, checkout):
    assembly()
    (checkout / "functions" / "two.py").write_text("")
    assert assembly() == 2
    assert assembly("other") == 3


def test_a_failed_synthesis_is_not_kept(checkout):
    def fail(output):
        output.mkdir()
        raise RuntimeError

    for _ in range(2):
        with pytest.raises(RuntimeError):
            deployment.assembly(checkout, checkout / "build", settings="iort", synthesize=fail)


def test_old_assemblies_are_removed(assembly, checkout):
    for i in range(8):
        assembly(f"n{i}")
    assert sum(path.is_dir() for path in (checkout / "build").iterdir()) == package._KEPT
