"""The downlinks of one or two robots, in one ROS graph and over a broker in memory.

Usage: ``downlinks.py CONFIG.json`` with ``downlink`` and ``share``; ``--ros2`` for a graph of ROS 2, and
``--guard`` for the process that stops the robot if this one dies. Each line of input is a command: ``send
MILLISECONDS JSON`` (a lease and a message), ``pose ROBOT JSON``, ``await TOPIC COUNT`` (waits for
subscribers, then prints ``heard``), ``guard`` (waits for the guard, then prints ``guarded``), ``stop`` (the
emergency stop), ``cut``, ``quit``.
"""

from __future__ import annotations

import itertools
import json
import logging
import sys
import time
from pathlib import Path

from iort_agent.common.schema import Place, load
from iort_agent.common.state import ClockOffset
from iort_agent.common.threads import SystemClock
from iort_agent.control import Bridge
from iort_agent.control.commands import Operator
from iort_agent.control.config import DownlinkConfig, share_rule
from iort_agent.control.downlink import Downlink
from iort_agent.control.guard import NODES, Guard
from iort_agent.control.questions import Questions
from iort_agent.files.upload import downloader, make_uploader
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.ros.ros1_node import DEFAULT_NODE
from iort_contract.messages.commands import Command, FleetMessage, encode_command, encode_fleet
from iort_contract.messages.questions import Answer, Refusal, decode_ask, encode_answer
from testkit.agent import Loopback, Published, link_of
from testkit.publishing import say

logging.basicConfig(stream=sys.stderr, level="INFO", format="%(levelname)s %(message)s")
file = Path(sys.argv[1])
settings, where, clock = json.loads(file.read_text()), Place(file), SystemClock()
uplink = Loopback(clock, Dispatcher())


def cloud(message: Published) -> None:
    """Answer a question with its body, if it has one."""
    if message.topic.startswith("ask/"):
        ask = decode_ask(message.payload)
        body = {"asked": ask.body} if ask.body else Refusal("no_data", "nothing yet")
        uplink.deliver(message.topic.replace("ask/", "answer/", 1), encode_answer(Answer(ask.id, body)))


uplink.verdict = cloud
link, ros = link_of(uplink, clock), 2 if "--ros2" in sys.argv else 1
graph = NODES[ros](DEFAULT_NODE, clock)
questions = None
if "ask" in settings.get("downlink", {}):
    uploader = make_uploader(link, root_ca=None, rate_kb_s=0)
    questions = Questions(link, uploader, download=downloader(None), offset=lambda: None)
config = load(DownlinkConfig, settings.get("downlink", {}), where)
guard = Guard(graph.base, config.motions(), clock, ros=ros) if "--guard" in sys.argv else None
downlink = Downlink(
    config,
    share_rule()(settings["share"], where) if "share" in settings else (),
    Bridge(link, graph, lambda: ClockOffset(0.0, 0.0)),
    boot="0badcafe",
    operator=Operator(lambda *_: None, lambda _: None, lambda: True),
    guard=guard,
    questions=questions,
)
uplink.start()
downlink.start()
say("started")
started_us = clock.now_us()
for seq, line in zip(itertools.count(), sys.stdin):
    verb, _, rest = line.strip().partition(" ")
    if verb == "quit":
        break
    if verb == "cut":
        uplink.cut()
    elif verb == "stop":
        downlink.set_stopped(True)
    elif verb == "guard":
        while not downlink.report()["guard"]:
            time.sleep(0.01)  # as above
        say("guarded")
    elif verb == "await":
        # A subscriber knows of a connection before its publisher does, and rospy has no event for it.
        topic, _, count = rest.partition(" ")
        while graph.listeners(topic) < int(count):
            time.sleep(0.01)
        say("heard")
    elif verb == "pose":
        robot, _, message = rest.partition(" ")
        fleet = FleetMessage("1badcafe", seq, clock.now_us(), json.loads(message))
        uplink.deliver(f"fleet/iort/{robot}/pose", encode_fleet(fleet))
    else:
        lease, _, message = rest.partition(" ")
        now_us = clock.now_us()
        command = Command("feedbeef", started_us, seq, now_us, 60_000, json.loads(message), int(lease))
        uplink.deliver("cmd/iort/car1/drive", encode_command(command))
downlink.halt()
uplink.stop(1)
downlink.close()
say(json.dumps([downlink.report(), [m.topic for m in uplink.published]]))
