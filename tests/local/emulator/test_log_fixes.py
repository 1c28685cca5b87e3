"""The worker marks the end of an invocation's log, without a timeout."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
from types import SimpleNamespace

import pytest
from ministack.core import lambda_runtime
from ministack.services import lambda_svc

from local.emulator.fixes import invocations
from testkit.waiting import GUARD_S


@pytest.fixture(scope="module")
def installed():
    """Close the gap in this process, and open it again."""
    kept = lambda_runtime._PYTHON_WORKER_SCRIPT, lambda_runtime.Worker._drain_stderr_bounded
    invocations.close_log_end()
    yield
    lambda_runtime._PYTHON_WORKER_SCRIPT, lambda_runtime.Worker._drain_stderr_bounded = kept


def test_the_worker_marks_the_end_of_each_invocations_log(installed, tmp_path):
    handler = "def handler(event, context):\n    if event:\n        print(event)\n    return event\n"
    (tmp_path / "said.py").write_text(handler)
    init = {"code_dir": str(tmp_path), "module": "said", "handler": "handler"}
    asked = [init, *({"event": event} for event in ("one", "", "two"))]
    done = subprocess.run(
        [sys.executable, "-c", lambda_runtime._PYTHON_WORKER_SCRIPT],
        input="".join(f"{json.dumps(each)}\n" for each in asked),
        capture_output=True,
        text=True,
        check=True,
        timeout=GUARD_S,
    )
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert [answer.get("result") for answer in answers] == [None, "one", "", "two"]
    assert done.stderr.splitlines() == ["one", invocations.END, invocations.END, "two", invocations.END]


def test_each_log_record_has_a_level(installed, tmp_path):
    handler = (
        "import logging\nlog = logging.getLogger('said')\nlog.setLevel(logging.INFO)\n"
        "def handler(event, context):\n    log.info('fine')\n    log.warning('not so %s', event)\n"
    )
    (tmp_path / "said.py").write_text(handler)
    init = {"code_dir": str(tmp_path), "module": "said", "handler": "handler"}
    done = subprocess.run(
        [sys.executable, "-c", lambda_runtime._PYTHON_WORKER_SCRIPT],
        input=f'{json.dumps(init)}\n{{"event": "good"}}\n',
        capture_output=True,
        text=True,
        check=True,
        timeout=GUARD_S,
    )
    lines = [line.split("\t") for line in done.stderr.splitlines()]
    assert [(line[0], line[-1]) for line in lines[:2]] == [("[INFO]", "fine"), ("[WARNING]", "not so good")]
    assert lines[0][1].endswith("Z")


def test_output_after_the_end_belongs_to_the_next_invocation(installed):
    lines = queue.Queue()
    for line in ("one", "two", invocations.END, "three", invocations.END, invocations.END):
        lines.put(line)
    worker = SimpleNamespace(config={"Runtime": "python3.13"}, _stderr_queue=lines)
    log = lambda_runtime.Worker._drain_stderr_bounded
    assert [log(worker) for _ in range(3)] == ["one\ntwo", "three", ""]


def test_a_traceback_is_one_event():
    trace = 'Traceback (most recent call last):\n  File "x.py", line 1, in f\n    g()\nValueError: text'
    failed = f"[ERROR]\t10:00Z\tit failed\n{trace}"
    records = ["[INFO]\tbefore", trace, "  indented", failed, "after"]
    assert lambda_svc._log_records("\n".join(records)) == records


def test_a_group_keeps_its_newest_logs_and_its_errors():
    kept, quiet, bad = invocations.KEPT, {"message": "START"}, {"message": "[ERROR]\twrong"}
    streams = {f"{i}": {"events": [quiet, bad] if i in {3, 4} else [quiet]} for i in range(3 * kept)}
    invocations.forget(streams)
    assert list(streams) == ["3", "4", *(f"{i}" for i in range(2 * kept, 3 * kept))]
