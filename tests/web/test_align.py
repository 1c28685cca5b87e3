"""What the page calculates without a browser: the way that a car has driven, from its positions."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from local.deployment import ROOT

# Bundles the module for node, and prints the distances of the answer on standard input.
PROGRAM = """
const { buildSync } = require("esbuild");
const { outputFiles } = buildSync({
  entryPoints: ["station/web/src/history/align.ts"], bundle: true, format: "cjs", write: false,
});
const bundled = { exports: {} };
new Function("module", "exports", outputFiles[0].text)(bundled, bundled.exports);
const answer = JSON.parse(require("fs").readFileSync(0));
console.log(JSON.stringify(bundled.exports.distance(answer, undefined)));
"""


def test_the_noise_of_positions_is_no_way() -> None:
    # 20 Hz: ten seconds of standing, then 10 m in ten seconds, all with 2 cm of noise.
    times = [i / 20 for i in range(400)]
    x = [max(0.0, t - 10) + 0.02 * math.sin(7 * i) for i, t in enumerate(times)]
    y = [0.02 * math.cos(11 * i) for i in range(400)]
    answer = {"times_s": times, "fields": {"x": {"mean": x}, "y": {"mean": y}}}
    done = subprocess.run(
        [Path(sys.executable).with_name("node"), "-e", PROGRAM],
        check=True,
        cwd=ROOT,
        input=json.dumps(answer),
        capture_output=True,
        text=True,
    )
    found = json.loads(done.stdout)
    assert found[200] < 0.3
    assert found[-1] == pytest.approx(10, rel=0.1)
