"""The end of an invocation's log.

AWS: does not apply; an invocation's time does not depend on its log.
ministack: reads the log from the worker's standard error and does not know where it ends. It waits 50 ms for
  a first line, ten times as long as a function runs that logs nothing. Here the worker prints a line at the
  end.
Test: tests/local/gaps/test_log_gap.py::test_the_worker_marks_the_end_of_each_invocations_log
Patch: none; the end has to be agreed for the workers of every runtime, not Python's alone
"""

from __future__ import annotations

import inspect
import queue
import time
from collections.abc import Callable
from typing import Any

from ministack.core import lambda_runtime

END = "=== end of the invocation's log, local/gaps/functions/log_end.py ==="
# The end of the worker's loop, with the patch log_levels: it sends the answer, and the log is complete.
_ANSWERED = "        _real_stdout.flush()\n\n# Lambda's own set-up of logging"
# For a worker that dies before it prints the end.
_MAX_WAIT_S = 1.0


def install() -> None:
    """Close the gap in this process."""
    worker = lambda_runtime._PYTHON_WORKER_SCRIPT
    if worker.count(_ANSWERED) != 1:
        raise RuntimeError("the end of ministack's Python worker must occur once")
    printed = f"        print({END!r}, file=sys.stderr, flush=True)\n"
    lambda_runtime._PYTHON_WORKER_SCRIPT = worker.replace(_ANSWERED, printed + _ANSWERED)
    drain = lambda_runtime.Worker._drain_stderr_bounded
    lambda_runtime.Worker._drain_stderr_bounded = _to_the_end(drain)


def is_open() -> bool:
    """Look at the parameters: the 50 ms are one, and a test must not measure them."""
    return "first_line_wait" in inspect.signature(lambda_runtime.Worker._drain_stderr_bounded).parameters


def _to_the_end(drain: Callable[..., str]) -> Callable[[Any], str]:
    def log(worker: Any) -> str:
        if not str(worker.config.get("Runtime", "")).startswith("python"):
            return drain(worker)
        lines: list[str] = []
        deadline = time.monotonic() + _MAX_WAIT_S
        while (left_s := deadline - time.monotonic()) > 0:
            try:
                line = worker._stderr_queue.get(timeout=left_s)
            except queue.Empty:
                break
            if line == END:
                break
            lines.append(line)
        return "\n".join(lines)

    return log
