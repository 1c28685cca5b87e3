"""What a robot has to tell: the topics of its ROS graph, and the VESCs on its serial ports. It only listens,
as a node of a name of its own, and asks a VESC for its values."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any, Callable, Iterator, List, Mapping, NamedTuple, Optional, Protocol, Sequence, Tuple

from iort_agent.common.threads import Clock, brief
from iort_agent.errors import SourceError
from iort_agent.ros import OnBytes, ros1_master, ros1_node, ros2_node
from iort_agent.sources.intake import BELIEVABLE_US
from iort_agent.sources.vesc import VescConfig
from iort_contract.limits import MessageError
from iort_contract.ros.decode import stamp_ns
from iort_contract.ros.definition import VARIABLE, Definition, parse

# A graph's topics are asked for again and again, because a node meets the others one by one.
LOOK_S = 0.25
# Bytes of a message from which its `uint8[]` are an image or a point cloud, and no small array.
LARGE = 16 * 1024
# The USB ids of the STM32 on every VESC, which many other boards have, too.
_STM32 = ("0483", "5740")
_RATE_HZ = 20.0
_NEVER = threading.Event()


class Topic(NamedTuple):
    """A topic as it was heard. ``rate_hz`` is None for fewer than two messages, ``size`` their mean of bytes.

    ``stamped`` tells that the messages' own times can be used. ``blobs`` are bytes in them, as in an image.
    The definition of a ``known`` type came with a message, or is installed.
    """

    name: str
    kinds: Sequence[str]
    messages: int = 0
    rate_hz: Optional[float] = None  # noqa: UP045 - a NamedTuple's types are evaluated, on Python 3.8 too
    size: int = 0
    stamped: bool = False
    blobs: bool = False
    published: bool = True
    known: bool = True


class Ros(NamedTuple):
    """A graph: of which ROS, 1 or 2, what a person calls it, and its topics."""

    version: int
    title: str
    topics: Sequence[Topic]


class Vesc(NamedTuple):
    """A serial port, how many times a VESC has answered there, and why not."""

    port: str
    samples: int
    why: str = ""


class Node(Protocol):
    """The agent's node in a graph, of either ROS, as far as it is needed here."""

    failed: str | None
    sim_time: bool

    def types(self) -> Mapping[str, Sequence[str]]:
        """The topics that somebody publishes or hears, and the types of each."""

    def subscribe(self, topic: str, handler: OnBytes) -> None: ...

    def connections(self, topic: str) -> int: ...

    def definition(self, kind: str) -> Definition: ...

    def start(self) -> None: ...

    def close(self) -> None: ...


# Told the seconds that are left, the topics and the messages so far.
Progress = Callable[[float, int, int], None]


# Of which ROS, what a person calls it, and the node.
Found = Tuple[int, str, Node]
Reasons = List[str]


def graphs(clock: Clock, reasons: Reasons) -> Iterator[Found]:
    """Each graph that this machine can join: its ROS, a title and the node. ``reasons`` gets why not."""
    name = f"iort_init_{os.getpid()}"
    try:
        yield 2, ros2_title(), ros2_node.shared(name, clock)
    except SourceError as error:
        reasons.append(str(error))
    uri = ros1_master.uri()
    try:
        found = ros1_node.shared(name, clock)
    except SourceError as error:
        reasons.append(str(error))
        return
    why = ros1_master.Master(uri, f"/{name}").unreachable()
    if why is None:
        yield 1, f"ROS 1, master at {uri}", found
    else:
        reasons.append(f"no ROS master at {uri}: {why}")
        found.close()


def ros2_title() -> str:
    """The ROS 2 of this environment, for a person."""
    names = (os.environ.get("ROS_DISTRO"), os.environ.get("RMW_IMPLEMENTATION"))
    domain = f"ROS_DOMAIN_ID {os.environ.get('ROS_DOMAIN_ID') or 0}"
    return f"ROS 2, {', '.join([*filter(None, names), domain])}"


def listen(node: Node, clock: Clock, seconds: float, progress: Progress) -> Sequence[Topic]:
    """Hear each topic of the graph for so long. Raises `SourceError` if the node leaves it."""
    heard: dict[str, _Heard] = {}
    node.start()
    until = clock.monotonic() + seconds
    while (left_s := until - clock.monotonic()) > 0:
        if node.failed:
            raise SourceError(node.failed)
        for name, kinds in node.types().items():
            if name not in heard:
                heard[name] = _Heard(clock)
                node.subscribe(name, heard[name].take)
            heard[name].kinds = kinds
        progress(left_s, len(heard), sum(one.messages for one in heard.values()))
        clock.wait(_NEVER, min(LOOK_S, left_s))
    return [heard[name].topic(name, node) for name in sorted(heard)]


class _Heard:
    """What has come of one topic. The node's threads call `take`."""

    def __init__(self, clock: Clock) -> None:
        self.kinds: Sequence[str] = ()
        self.messages = self._bytes = 0
        self._clock = clock
        self._first_s = self._last_s = 0.0
        self._newest: tuple[Mapping[str, str], bytes, int] | None = None

    def take(self, header: Mapping[str, str], data: bytes) -> None:
        self._last_s = self._clock.monotonic()
        self._first_s = self._first_s or self._last_s
        self._newest = header, data, self._clock.now_us()
        self._bytes += len(data)
        self.messages += 1

    def topic(self, name: str, node: Node) -> Topic:
        header, data, arrival_us = self._newest or ({}, b"", 0)
        kind = header.get("type") or (self.kinds[0] if self.kinds else "")
        definition = _definition(kind, header.get("message_definition", ""), node)
        span_s = self._last_s - self._first_s
        stamped = definition is not None and definition.stamped()
        if stamped and self._newest is not None:
            stamp = stamp_ns(data, ros2=kind.count("/") == 2)
            stamped = stamp is not None and abs(stamp // 1000 - arrival_us) < BELIEVABLE_US
        return Topic(
            name,
            self.kinds or (kind,),
            self.messages,
            rate_hz=(self.messages - 1) / span_s if span_s > 0 else None,
            size=round(self._bytes / self.messages) if self.messages else 0,
            stamped=stamped and not node.sim_time,
            blobs=definition is not None and _has_blobs(definition),
            published=bool(self.messages or node.connections(name)),
            known=definition is not None,
        )


def _definition(kind: str, text: str, node: Node) -> Definition | None:
    try:
        return parse(kind, text) if text.strip() else node.definition(kind)
    except (MessageError, SourceError):
        return None


def _has_blobs(definition: Definition) -> bool:
    fields = [field for kind in definition.types for field in definition.types[kind]]
    return any(field.length == VARIABLE and field.kind in ("uint8", "char") for field in fields)


def ports(dev: Path = Path("/dev"), sysfs: Path = Path("/sys/class/tty")) -> Iterator[str]:
    """The serial ports at which a VESC may be: by the name of our udev rule, else of an STM32 on USB by a
    name that stays."""
    seen = set()
    if (dev / "vesc").exists():
        seen.add((dev / "vesc").resolve())
        yield str(dev / "vesc")
    for path in [*sorted(dev.glob("serial/by-id/*")), *sorted(dev.glob("ttyACM*"))]:
        real = path.resolve()
        if real not in seen and _usb_ids(sysfs / real.name / "device") == _STM32:
            seen.add(real)
            yield str(path)


def _usb_ids(device: Path) -> tuple[str, ...]:
    try:
        # The interface's folder lies in its device's.
        folder = device.resolve().parent
        return tuple((folder / name).read_text().strip() for name in ("idVendor", "idProduct"))
    except OSError:
        return ()


class Polls:
    """Asks the VESC at a port for its values, in a thread, until `end`."""

    def __init__(self, port: str, clock: Clock) -> None:
        self._port, self._why = port, "no VESC answers there"
        self._source = VescConfig(port, rate_hz=_RATE_HZ).build(clock)
        self._stop, self._over = threading.Event(), threading.Event()
        self._clock, self._began = clock, clock.monotonic()
        brief("vesc", self._run)

    def _run(self) -> None:
        try:
            self._source.run(_forget, self._stop)
        except SourceError as error:
            self._why = str(error)
        finally:
            self._over.set()

    def end(self, least_s: float) -> Vesc:
        """Stop once it has had its time, and say what has come."""
        self._clock.wait(self._over, self._began + least_s - self._clock.monotonic())
        self._stop.set()
        self._over.wait()
        samples = self._source.counts.samples
        return Vesc(self._port, samples, "" if samples else self._why)


def _forget(*_sample: Any, **_more: Any) -> float:
    return 0.0
