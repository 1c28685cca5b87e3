"""An agent with a recorder and no broker, for tests that kill it: python -m ... FOLDER.

It writes a line for each message to FOLDER/sent. Its trigger fires once, after one and a half seconds at the
earliest, unless the plan knows the trigger already."""

from __future__ import annotations

import sys
import threading
from dataclasses import replace
from pathlib import Path

from iort_agent.agent import Agent
from iort_agent.common.threads import SystemClock
from iort_agent.config import Config
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.recorder.config import RecorderConfig
from iort_agent.runtime import Runtime
from iort_agent.sources import Emit
from iort_contract.messages.recorder import Wanted
from iort_contract.ros.message import RosMessage, RosType
from testkit.agent import Loopback, MemorySpool
from tests.unit.agent.test_agent import Script

TEXT = RosType("/chatter", "std_msgs/msg/String", "RIHS01_1", "string data")
TRIGGER = {"when": "current_input < -15", "before_s": 1.0, "after_s": 3.0, "cooldown_s": 3600.0}


def main(folder: Path) -> None:
    """Run until somebody ends the process."""
    first = not (folder / "ring" / "recorder.json").exists()
    clock = SystemClock()

    def play(emit: Emit, stop: threading.Event) -> None:
        i, braked = 0, not first
        with (folder / "sent").open("a") as sent:
            while not clock.wait(stop, 0.01):
                now_us = clock.now_us()
                # The recorder follows the shadow once a second.
                hard = not braked and i >= 150 and agent.recorder is not None and bool(agent.recorder.answers)
                braked = braked or hard
                emit("vesc", now_us, {"current_input": -20.0 if hard else 0.0})
                emit("chatter", now_us, RosMessage(f"{now_us}".encode(), TEXT))
                sent.write(f"{now_us}\n")
                sent.flush()
                i += 1

    config = Config("car1", "host", Path(), Path(), (Script(play, "vesc", "chatter"),))
    # What a killed process wrote is in the kernel: a slow disk must not hold up the ring here.
    recorder = RecorderConfig(folder=folder / "ring", keep_free_mb=0, sync_s=60.0)
    agent = Agent(
        replace(config, recorder=recorder),
        uplink=Loopback(clock, Dispatcher(), connected=False),
        spool=MemorySpool(max_bytes=10**9),
        clock=clock,
    )
    assert agent.recorder is not None
    agent.recorder.want(Wanted({"hardbrake": TRIGGER}, {}))
    Runtime(agent).run(drain_s=0)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
