"""The notebooks of the documentation, run by Jupyter's own kernel on the embedded cloud."""

from __future__ import annotations

import json
import re

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_analysis.samples.blocks import Block
from iort_station.cloud import AWS_NAMED
from iort_station.fleet import registry
from local.deployment import ROOT
from tests.local.analysis.test_analysis import ago, stored
from tests.unit.analysis.simulated import streams

pytestmark = [
    pytest.mark.slow,
    # Jupyter's client leaves its sockets to the garbage collector.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


@pytest.fixture
def run(embedded, monkeypatch, tmp_path):
    """Run a notebook for a robot; return what its cells printed, how many pictures they drew, and the values
    of expressions after it."""
    for name in AWS_NAMED:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")

    def executed(name, robot, **expressions):
        notebook = nbformat.read(ROOT / "docs/notebooks" / name, as_version=4)
        cells = notebook.cells
        assert not any(cell.get("outputs") for cell in cells), "a notebook is kept without its outputs"
        (named,) = [cell for cell in cells if cell.source.startswith("ROBOT = ")]
        named.source = re.sub(r'ROBOT = ".*"', f"ROBOT = {robot!r}", named.source)
        for cell in cells:
            cell.source = cell.source.replace(
                "connect()", f"connect({str(embedded.folder / 'cloud.json')!r})"
            )
        values = "".join(f"{key!r}: {text}, " for key, text in expressions.items())
        cells.append(
            nbformat.v4.new_code_cell(f"import json\nprint(json.dumps({{{values}}}, default=float))")
        )
        NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
        outputs = [output for cell in cells for output in cell.get("outputs", ())]
        printed = [output.text for output in outputs if output.output_type == "stream"]
        pictures = [output for output in outputs if "image/png" in output.get("data", {})]
        return "".join(printed[:-1]), len(pictures), json.loads(printed[-1])

    return executed


def test_two_laps_are_compared(embedded, bundle, run, iort):
    car = bundle().robot
    stored(embedded, car, ago(300, streams(120)))
    registry.set_vehicle(embedded.cloud, car, {"speed_to_erpm_gain": 4614.0})

    printed, pictures, values = run(
        "compare_laps.ipynb", car, best="best", slowest="slowest", end_s="delta_s[-1]", lost_s="lost_s"
    )

    answer = json.loads(iort("laps", car, "--json").stdout)
    times = {lap["lap"]: lap["time_s"] for lap in answer["runs"][0]["laps"] if lap["complete"]}
    assert values["best"] == min(times, key=times.get)
    assert values["slowest"] == max(times, key=times.get)
    assert values["end_s"] == pytest.approx(max(times.values()) - min(times.values()), abs=0.02)
    assert values["lost_s"] > 0
    assert f"lap {values['slowest']} loses" in printed
    assert pictures == 1


def driven(seed, **battery):
    """A minute of a car with another battery."""
    car = Vehicle(VehicleConfig(**battery), seed)
    sensors = Sensors(car, seed)
    samples = []
    for _ in range(3000):
        car.step(0.02)
        samples.append(sensors.vesc())
    times = 1_700_000_000_000_000 + np.arange(len(samples), dtype=np.int64) * 20_000
    columns = {name: np.array([float(one[name]) for one in samples]) for name in samples[0]}
    return {"vesc": Block(times, columns)}


@pytest.mark.parametrize(
    ("worn", "expected"),
    [
        (
            {"battery_resistance_ohm": 0.06, "battery_slow_resistance_ohm": 0.03},
            ("a higher resistance", 2.0),
        ),
        ({"charge": 0.3}, ("less charge at its start", 1.0)),
    ],
)
def test_the_reason_of_a_sag_is_the_one_that_the_car_has(embedded, bundle, run, worn, expected):
    cause, ratio = expected
    car = bundle().robot
    stored(embedded, car, ago(1000, driven(1)), run="000000aa")
    stored(embedded, car, ago(300, driven(2, **worn)), run="000000bb")

    printed, pictures, values = run(
        "battery_sag.ipynb", car, cause="cause", sure="bool(sure)", mohm="list(table['resistance_mohm'])"
    )

    assert (values["cause"], values["sure"]) == (cause, True)
    assert values["mohm"][1] / values["mohm"][0] == pytest.approx(ratio, rel=0.15)
    assert f"mostly {cause}" in printed
    assert pictures == 1
