"""The Python of the pages, on the embedded cloud."""

from __future__ import annotations

import re
from importlib.util import module_from_spec, spec_from_file_location

import pytest

from iort_station.cloud import AWS_NAMED, EMBEDDED
from local.deployment import ROOT
from tests.local.conftest import recorded, run_agent


@pytest.fixture
def follow(embedded, bundle, tmp_path, monkeypatch):
    """Run a page's Python for a car that has driven for eight seconds; its names afterwards."""
    car = bundle(sources=[{"type": "sim", "rate_hz": 50, "duration_s": 8}])
    run_agent(car)
    recorded(embedded, car.robot, "vesc")
    # The folder in which a demo runs.
    (tmp_path / EMBEDDED.parent.parent).mkdir(parents=True)
    (tmp_path / EMBEDDED.parent).symlink_to(embedded.folder)
    monkeypatch.chdir(tmp_path)
    for name in AWS_NAMED:
        monkeypatch.delenv(name, raising=False)

    def run(page):
        code = "\n".join(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL))
        names = {}
        exec(re.sub(r'"car\d"', repr(car.robot), code), names)
        return names

    return run


def test_the_notebook_answers_its_questions(follow, capsys):
    names = follow("docs/tutorials/first-question.md")
    assert len(names["frame"]) == 400
    assert names["fastest"] == names["frame"]["speed_mps"].max() > 1
    assert names["hardest"]["current_motor"].iloc[0] == names["frame"]["current_motor"].min()
    assert 0 < names["energy_wh"] < 1
    assert "m/s, at" in capsys.readouterr().out
    follow("README.md")
    assert len(follow("docs/reference/queries.md")["ride"].times_us) == 400


def test_the_librarys_example_says_what_was_recorded_and_that_it_is_complete(follow, capsys):
    names = follow("docs/tutorials/first-question.md")
    capsys.readouterr()
    spec = spec_from_file_location("library", ROOT / "docs" / "examples" / "library.py")
    example = module_from_spec(spec)
    spec.loader.exec_module(example)
    example.main(names["ride"].robot)
    printed = capsys.readouterr().out
    assert re.search(r"ended after \d+ s, 400 samples of vesc: ", printed)
    assert re.search(r"^\d+\.\d\d m/s of 400 samples, complete$", printed, re.MULTILINE)
