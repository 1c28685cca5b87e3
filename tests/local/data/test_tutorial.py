"""The notebook of docs/tutorials/first-question.md, on the embedded cloud."""

from __future__ import annotations

import re

from iort_station.cloud import EMBEDDED
from local.deployment import ROOT
from tests.local.conftest import recorded, run_agent

PAGE = ROOT / "docs" / "tutorials" / "first-question.md"


def test_the_notebook_answers_its_questions(embedded, bundle, tmp_path, monkeypatch, capsys):
    car = bundle(sources=[{"type": "sim", "rate_hz": 50, "duration_s": 8}])
    run_agent(car)
    recorded(embedded, car.robot, "vesc")
    # The demo's folder, with its car.
    (tmp_path / EMBEDDED.parent.parent).mkdir(parents=True)
    (tmp_path / EMBEDDED.parent).symlink_to(embedded.folder)
    monkeypatch.chdir(tmp_path)
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL))
    names = {}
    exec(code.replace('"car1"', repr(car.robot)), names)
    assert len(names["frame"]) == 400
    assert names["fastest"] == names["frame"]["speed_mps"].max() > 1
    assert names["hardest"]["current_motor"].iloc[0] == names["frame"]["current_motor"].min()
    assert 0 < names["energy_wh"] < 1
    assert "m/s, at" in capsys.readouterr().out
