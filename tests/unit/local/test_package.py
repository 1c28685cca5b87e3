"""local/emulator/package.py: folders that several processes make at the same time."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor
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
    assert {path for path in tmp_path.iterdir() if path.is_dir()} == set(found[2:])


def test_one_makes_a_folder_while_the_others_wait(tmp_path: Path) -> None:
    making, made = threading.Event(), list[Path]()

    def make(folder: Path) -> None:
        made.append(folder)
        # The others have come meanwhile, and must not begin.
        making.wait(0.2)
        folder.mkdir()

    with ThreadPoolExecutor(3) as pool:
        found = set(pool.map(lambda _: artifact(tmp_path, "key", [], make), range(3)))
    assert (len(found), len(made)) == (1, 1)


def test_what_an_ended_process_was_making_is_made_anew(tmp_path: Path) -> None:
    def fails(folder: Path) -> None:
        (folder / "half").mkdir(parents=True)
        raise OSError

    with pytest.raises(OSError):
        artifact(tmp_path, "key", [], fails)
    assert list(artifact(tmp_path, "key", [], _make).iterdir()) == []


def test_another_users_checkout_keeps_what_it_has_and_refuses_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = artifact(tmp_path, "there", [], _make)
    # Root may write everywhere.
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert artifact(tmp_path, "there", [], _make) == found
    with pytest.raises(LocalError, match=f"you must be able to write {tmp_path}: its owner"):
        artifact(tmp_path, "new", [], _make)
