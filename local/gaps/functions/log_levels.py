"""A log line has its level.

AWS: sets up `logging` before it loads a function, so that a line has level and time
  (https://docs.aws.amazon.com/lambda/latest/dg/python-logging.html).
ministack: leaves `logging` as it is; a line has its text only.
Test: tests/local/test_log_gap.py::test_what_a_function_logs_says_how_bad_it_is
Patch: local/patches/log_levels.patch
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from ministack.core import lambda_runtime

_RUN = "\nrun()\n"
# As Lambda's "text" format has it, without the request's id.
_LOGGING = """
import logging
_lines = logging.StreamHandler(sys.stderr)
_format = logging.Formatter("[%(levelname)s]\\t%(asctime)s.%(msecs)03dZ\\t%(message)s", "%Y-%m-%dT%H:%M:%S")
_format.converter = time.gmtime
_lines.setFormatter(_format)
logging.getLogger().addHandler(_lines)
"""
_HANDLER = "import logging\ndef handler(event, context):\n    logging.getLogger('x').warning('text')\n"


def install() -> None:
    """Close the gap in this process."""
    worker = lambda_runtime._PYTHON_WORKER_SCRIPT
    if worker.count(_RUN) != 1:
        raise RuntimeError("the start of ministack's Python worker must occur once")
    lambda_runtime._PYTHON_WORKER_SCRIPT = worker.replace(_RUN, f"{_LOGGING}{_RUN}")


def is_open() -> bool:
    """Run the worker with a function that logs."""
    with TemporaryDirectory() as folder:
        (Path(folder) / "logs.py").write_text(_HANDLER)
        init = {"code_dir": folder, "module": "logs", "handler": "handler"}
        done = subprocess.run(  # noqa: S603 - ministack's worker in our own Python
            [sys.executable, "-c", lambda_runtime._PYTHON_WORKER_SCRIPT],
            input=f'{json.dumps(init)}\n{{"event": {{}}}}\n',
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
    return "[WARNING]" not in done.stderr
