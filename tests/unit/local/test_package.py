"""local/emulator/package.py: folders that several processes make at the same time."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from local.emulator.package import artifact
from local.processes import LocalError


def _make(folder: Path) -> None:
    folder.mkdir()


def test_a_folder_is_made_once_for_each_key(tmp_path: Path) -> None:
    made: list[Path] = []
    for key in ("a", "a", "b"):
        artifact(tmp_path / "kept", key, [], lambda folder: (made.append(folder), folder.mkdir()))
    assert len(made) == 2


def test_the_newest_folders_stay(tmp_path: Path) -> None:
    found = []
    for key in range(6):
        found.append(artifact(tmp_path, str(key), [], _make))
        os.utime(found[-1], (key, key))
    assert set(tmp_path.iterdir()) == set(found[2:])


def test_a_folder_that_another_process_is_making_stays(tmp_path: Path) -> None:
    others = [tmp_path / f"digest.{number}" for number in range(5)]
    for other in others:
        other.mkdir()
    artifact(tmp_path, "key", [], _make)
    assert all(other.is_dir() for other in others)


def test_a_folder_that_an_ended_process_was_making_goes(tmp_path: Path) -> None:
    left = tmp_path / "digest.1"
    left.mkdir()
    yesterday = time.time() - 86_400
    os.utime(left, (yesterday, yesterday))
    artifact(tmp_path, "key", [], _make)
    assert not left.exists()


def test_a_folder_may_go_while_the_ages_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = tmp_path / "digest.1"
    listed = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda folder: iter([*listed(folder), gone]))
    assert artifact(tmp_path, "key", [], _make).is_dir()


def test_another_users_checkout_keeps_what_it_has_and_refuses_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = artifact(tmp_path, "there", [], _make)
    # Root may write everywhere.
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert artifact(tmp_path, "there", [], _make) == found
    with pytest.raises(LocalError, match=f"you must be able to write {tmp_path}: its owner"):
        artifact(tmp_path, "new", [], _make)
