"""What the publishers of tests and benches share, whatever their ROS.

Each is a program in a process of its own. It says ``ready`` when its subscribers are there, follows the lines
of its input, and keeps its rates by deadlines: a late message makes none of the later ones late.
"""

from __future__ import annotations

import argparse
import base64
import json
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any, Protocol

_LOOK_S = 0.01


def say(line: str) -> None:
    """Write a line for the program that has started this one, at once; print writes the newline separately,
    so two threads' lines would mix."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def ready(
    subscribers: Callable[[], int],
    wanted: int = 1,
    stop: threading.Event | None = None,
    within_s: float = float("inf"),
) -> None:
    """Say ``ready`` once there are so many subscribers. Without them the program ends after ``within_s``."""
    stop, give_up = stop or threading.Event(), time.monotonic() + within_s
    while subscribers() < wanted and not stop.is_set():
        if time.monotonic() > give_up:
            sys.exit(f"no {wanted} subscribers of every topic within {within_s:g} s")
        stop.wait(_LOOK_S)
    say("ready")


class Deadlines:
    """Times since now."""

    def __init__(self) -> None:
        self._began = time.monotonic()

    def wait(self, due_s: float, stop: threading.Event | None = None) -> None:
        """Wait until so many seconds have passed, or until ``stop``."""
        left_s = self._began + due_s - time.monotonic()
        if left_s > 0:
            (time.sleep if stop is None else stop.wait)(left_s)


class Line(Protocol):
    """One topic of a publisher; ``due_s`` is when its next message is due."""

    due_s: float

    def publish(self) -> object: ...


def publish_in_turn(lines: Sequence[Line], seconds: float) -> None:
    """Publish the topic that is due, for so long. A loop over twenty topics costs less than a thread each."""
    deadlines = Deadlines()
    while (line := min(lines, key=lambda line: line.due_s)).due_s < seconds:
        deadlines.wait(line.due_s)
        line.publish()


# --- a node of a proof ---------------------------------------------------------------------------------


def node_options(nodes: Mapping[str, Any]) -> argparse.ArgumentParser:
    """The options of a node that `prove` runs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("node", choices=nodes)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--sent", type=argparse.FileType("w"), required=True)
    parser.add_argument("--subscribers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    return parser


class Recorded:
    """A topic whose messages are also written to a record: a line of topic, time in ns and base64. When its
    number of subscribers changes, JSON says the number of the message that found the change."""

    def __init__(self, topic: Any, options: argparse.Namespace) -> None:
        self.topic, self.sent, self.due_s = topic, 0, 0.0
        self._node, self._seconds, self._subscribers = options.node, options.seconds, 0
        self._record: IO[str] = options.sent

    def subscribers(self) -> int:
        """How many there are now."""
        raise NotImplementedError

    def send(self, now_ns: int) -> bytes:
        """Publish a message of now, and return its bytes."""
        raise NotImplementedError

    def publish(self) -> None:
        topic, subscribers = self.topic, self.subscribers()
        now_ns = time.time_ns()
        if subscribers != self._subscribers:
            self._subscribers = subscribers
            change = {"topic": topic.name, "n": self.sent, "subscribers": subscribers, "t_ns": now_ns}
            say(json.dumps({**change, "node": self._node}))
        content = self.send(now_ns)
        self._record.write(f"{topic.name} {now_ns} {base64.b64encode(content).decode()}\n")
        self.sent += 1
        # A topic without a rate is published once.
        self.due_s = self.sent / topic.rate_hz if topic.rate_hz else self._seconds


def prove(lines: Sequence[Recorded], options: argparse.Namespace) -> None:
    """Be a node of a proof: begin at a line of the input, say ``sent {...}`` with the number of messages by
    topic, and end at the next line. What is published stays available to subscribers until then."""
    ready(lambda: min(line.subscribers() for line in lines), options.subscribers)
    sys.stdin.readline()
    publish_in_turn(lines, options.seconds)
    options.sent.close()
    say("sent " + json.dumps({line.topic.name: line.sent for line in lines}))
    sys.stdin.readline()


# --- a message whose field counts ----------------------------------------------------------------------


def counter_options() -> argparse.ArgumentParser:
    """The options of `count`."""
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("topic")
    parser.add_argument("type")
    parser.add_argument("--field", help="dotted path of the field that counts")
    parser.add_argument("--rate", type=float, default=50)
    parser.add_argument("--start", type=int, default=0, help="the first value of the counter")
    parser.add_argument("--count", type=int, default=0, help="stop counting after so many")
    parser.add_argument("--stamp", default="now", help="now, or seconds since the epoch")
    parser.add_argument("--latch", action="store_true", help="repeat the last message to who connects")
    parser.add_argument("--at-once", action="store_true", help="wait for no subscriber")
    return parser


def count(
    message: Any,
    options: argparse.Namespace,
    subscribers: Callable[[], int],
    publish: Callable[[Any], object],
) -> None:
    """Publish the message with values of the field that count up, until the line ``quit``; the last line of
    the output is ``sent N``."""
    stop = threading.Event()
    threading.Thread(target=_listen, args=(stop,), daemon=True).start()
    ready(subscribers, 0 if options.at_once else 1, stop)
    *path, last = options.field.split(".") if options.field else [""]
    target, n, deadlines = message, 0, Deadlines()
    for name in path:
        target = getattr(target, name)
    while not stop.is_set():
        if options.count and n >= options.count:
            stop.wait()
            break
        if last:
            setattr(target, last, type(getattr(target, last))(options.start + n))
        if hasattr(message, "header"):
            ns = time.time_ns() if options.stamp == "now" else int(float(options.stamp) * 1e9)
            stamp = message.header.stamp
            names = ("secs", "nsecs") if hasattr(stamp, "secs") else ("sec", "nanosec")
            for name, part in zip(names, divmod(ns, 10**9), strict=True):
                setattr(stamp, name, part)
            message.header.frame_id = "base_link"
        publish(message)
        n += 1
        deadlines.wait(n / options.rate, stop)
    say(f"sent {n}")


def _listen(stop: threading.Event) -> None:
    for line in sys.stdin:
        if line.strip() == "quit":
            break
    stop.set()
