"""A source of the agent alone, in its own process; each sample is a line of JSON on standard output.

A line has stream, time and values, then the message's bytes. Usage:
``collector.py CONFIG.json`` with the source's settings, and its ``type`` unless it is ``ros1``; ``quit`` on
standard input ends it, and the last line is the source's report.
"""

from __future__ import annotations

import base64
import json
import logging
import sys
import threading
import time
from pathlib import Path

from iort_agent.common.schema import Place, load
from iort_agent.common.threads import SystemClock
from iort_agent.sources.registry import SOURCES
from iort_contract.ros.message import RosMessage
from testkit.publishing import say

logging.basicConfig(stream=sys.stderr, level="INFO", format="%(levelname)s %(message)s")
file = Path(sys.argv[1])
settings = json.loads(file.read_text())
config = load(SOURCES[settings.pop("type", "ros1")], settings, Place(file))
source, stop = config.build(SystemClock()), threading.Event()


def listen() -> None:
    for _ in sys.stdin:
        break
    stop.set()


def emit(stream, t_us, values, more=False):
    sample = [stream, t_us, dict(values)]
    if isinstance(values, RosMessage):
        sample.append(base64.b64encode(values.raw).decode())
    say(json.dumps(sample))
    # The live lane wants ten a second.
    return time.monotonic() + 0.1


threading.Thread(target=listen, daemon=True).start()
source.run(emit, stop)
say(json.dumps(source.report()))
