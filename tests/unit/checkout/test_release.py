"""scripts/release.py: one version for all parts, and which commits are no release."""

from __future__ import annotations

import re
import shutil
import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

from scripts import release, wheelhouse
from scripts.release import ReleaseError
from testkit import ROOT


def git(folder: Path, *arguments: str) -> str:
    named = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    command = ["git", "-C", str(folder), *named, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A clean checkout that states the versions of the real one, 1.2.3, and has it in its changelog."""
    for path in release.versions():
        copy = tmp_path / path.relative_to(ROOT)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy(path, copy)
    release.set_version("1.2.3", tmp_path)
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## 1.2.3 - 2026-01-02\n\n## 1.2.2 - 2026-01-01\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    return tmp_path


def test_every_part_states_the_same_version() -> None:
    stated = release.versions()
    # Each states its own, and that of each part that it needs.
    assert {path.relative_to(ROOT).as_posix(): len(found) for path, found in stated.items()} == {
        "contract/pyproject.toml": 1, "contract/package.xml": 1, "contract/setup.py": 1,
        "device/pyproject.toml": 2, "device/package.xml": 1, "device/setup.py": 1,
        "analysis/pyproject.toml": 2, "station/pyproject.toml": 3,
    }  # fmt: skip
    assert {number for found in stated.values() for number in found} == {release.version()}
    assert {version(f"iort-{part}") for part in ("contract", "agent", "analysis", "station")} == {
        release.version()
    }


def test_the_changelog_begins_with_the_version() -> None:
    first = re.search(r"(?m)^## (\S+) - (\d{4}-\d\d-\d\d|unreleased)$", (ROOT / "CHANGELOG.md").read_text())
    assert first is not None
    assert first[1] == release.version()


def test_a_version_is_set_everywhere(checkout: Path) -> None:
    release.set_version("10.0.2", checkout)
    assert {number for found in release.versions(checkout).values() for number in found} == {"10.0.2"}
    assert release.version(checkout) == "10.0.2"
    # Nothing else has changed: back, and it is as it was.
    release.set_version("1.2.3", checkout)
    assert git(checkout, "status", "--porcelain") == ""


def test_a_version_that_is_none_is_refused(checkout: Path) -> None:
    with pytest.raises(ReleaseError, match=r"must be three numbers such as 1\.2\.3, got '1\.2'"):
        release.set_version("1.2", checkout)


def test_a_clean_checkout_with_a_changelog_is_a_release(checkout: Path) -> None:
    release.refuse(checkout, tag=True)


def test_a_change_that_is_not_committed_is_refused(checkout: Path) -> None:
    (checkout / "new").touch()
    with pytest.raises(ReleaseError, match=r"must have no change that is not committed, got\n\?\? new"):
        release.refuse(checkout)


def test_a_new_file_that_git_is_told_to_hide_is_refused(checkout: Path) -> None:
    git(checkout, "config", "status.showUntrackedFiles", "no")
    (checkout / "new").touch()
    with pytest.raises(ReleaseError, match=r"must have no change that is not committed, got\n\?\? new"):
        release.refuse(checkout)


def test_another_commit_than_the_built_one_is_not_tagged(checkout: Path) -> None:
    built = release.refuse(checkout, tag=True)
    assert release.refuse(checkout, tag=True, built=built) == built
    git(checkout, "commit", "--quiet", "--allow-empty", "--message", "second")
    with pytest.raises(ReleaseError, match=f"the checkout must stay at {built}, which is built, got"):
        release.refuse(checkout, tag=True, built=built)


@pytest.mark.parametrize("heading", ["1.2.3 - unreleased", "1.2.4 - 2026-01-02", "1.2.3"])
def test_a_changelog_without_the_version_and_a_date_is_refused(checkout: Path, heading: str) -> None:
    (checkout / "CHANGELOG.md").write_text(f"# Changelog\n\n## {heading}\n")
    git(checkout, "commit", "--quiet", "--all", "--message", "changelog")
    with pytest.raises(ReleaseError, match=rf"'## 1\.2\.3 - DATE', got '## {heading}' first"):
        release.refuse(checkout)


def test_a_tagged_version_is_built_again_from_its_own_commit_alone(checkout: Path) -> None:
    git(checkout, "tag", "--annotate", "v1.2.3", "--message", "1.2.3")
    release.refuse(checkout)
    with pytest.raises(ReleaseError, match=r"1\.2\.3 must not be tagged yet"):
        release.refuse(checkout, tag=True)
    git(checkout, "commit", "--quiet", "--allow-empty", "--message", "second")
    with pytest.raises(
        ReleaseError, match=r"set the next version with `python -m scripts\.release version NUMBER`"
    ):
        release.refuse(checkout)


def test_a_folder_that_is_no_checkout_is_refused(checkout: Path) -> None:
    shutil.rmtree(checkout / ".git")
    with pytest.raises(ReleaseError, match="must succeed, got: fatal: not a git repository"):
        release.refuse(checkout)


@pytest.mark.parametrize("architecture", wheelhouse.ARCHITECTURES)
@pytest.mark.parametrize("python", wheelhouse.PYTHONS)
def test_the_lock_names_one_version_of_each_package_for_each_robot(architecture: str, python: str) -> None:
    pinned = dict(wheelhouse.needed(architecture, python))
    names = [one.partition("==")[0] for one in pinned]
    assert len(names) == len(set(names))
    assert {"awscrt", "cryptography", "mcap", "numpy", "pip", "pyserial", "websocket-client"} <= set(names)
    assert all(re.fullmatch("sha256:[0-9a-f]{64}", one) for hashes in pinned.values() for one in hashes)
    assert all(pinned.values())


def test_the_robots_tests_run_on_what_the_oldest_robot_gets() -> None:
    tested = (ROOT / "requirements" / "oldest.txt").read_text()
    pinned = {one for one, _ in wheelhouse.needed("aarch64", "3.8") if not one.startswith("pip==")}
    assert {one for one in pinned if f"\n{one} " not in tested} == set()


def test_an_architecture_without_packages_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ReleaseError, match="must be one of aarch64, x86_64, got 'armv7l'"):
        wheelhouse.make("armv7l", [], tmp_path)
    (tmp_path / "dist").mkdir()
    (tmp_path / "dist" / "SHA256SUMS").touch()
    with pytest.raises(ReleaseError, match="must be one of aarch64, x86_64, got 'armv7l'"):
        release.make(["aarch64", "armv7l"], tmp_path / "dist")
    assert (tmp_path / "dist" / "SHA256SUMS").exists()
