"""Modules of the page, run by node without a browser."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from local.deployment import ROOT

# Bundles a module of the page for node, gives it to a script as `page`, and prints what the script returns.
PROGRAM = """
// Some modules ask the browser at once, for what no calculation needs.
const anything = new Proxy(() => anything, { get: () => anything });
Object.assign(globalThis, { window: anything, document: anything });
const { module: path, script, given } = JSON.parse(require("fs").readFileSync(0));
const { outputFiles } = require("esbuild").buildSync({
  entryPoints: [`station/web/src/${path}`], bundle: true, format: "cjs", write: false,
});
const bundled = { exports: {} };
new Function("module", "exports", outputFiles[0].text)(bundled, bundled.exports);
console.log(JSON.stringify(new Function("page", "given", script)(bundled.exports, given)));
"""


def run(module: str, script: str, *given: Any) -> Any:
    """What a script returns that has a module of the page as ``page``, and ``given``."""
    done = subprocess.run(
        [Path(sys.executable).with_name("node"), "-e", PROGRAM],
        check=True,
        cwd=ROOT,
        input=json.dumps({"module": module, "script": script, "given": given}),
        capture_output=True,
        text=True,
    )
    return json.loads(done.stdout)


def call(module: str, name: str, *given: Any) -> Any:
    """The result of a function of the page."""
    return run(module, f"return page.{name}(...given)", *given)
