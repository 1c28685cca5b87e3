"""What is measured: the embedded cloud, started for the bench, or a deployment in an AWS account."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from contract import DEFAULT_NAMESPACE
from local.cloud import EmbeddedCloud
from station import keys, robots
from station.cloud import Cloud
from station.listener import Listener

EMBEDDED, AWS = "embedded", "aws"
Say = Callable[[str], None]


@dataclass
class Target:
    """A deployment, with robots that are registered for the bench and removed after it."""

    kind: str
    cloud: Cloud
    folder: Path
    embedded: EmbeddedCloud | None = None
    _robots: list[str] = field(default_factory=list)

    def robot(self, name: str, **settings: Any) -> robots.Bundle:
        """Register a robot; its agent's settings are ``settings``."""
        bundle = robots.add(self.cloud, name, out=self.folder / "robots", settings=settings)
        self._robots.append(name)
        return bundle

    def listener(self, robot: str) -> Listener:
        """A subscriber of the robot's channel."""
        pubnub = keys.load(self.cloud)
        return Listener(
            subscribe_key=pubnub.subscribe_key,
            robot=robot,
            namespace=self.cloud.namespace,
            **pubnub.server(),
        )

    def remove_robots(self) -> None:
        """Take the robots away again; what they sent expires by itself."""
        while self._robots:
            robots.remove(self.cloud, self._robots.pop())


@contextmanager
def open_target(
    kind: str, *, namespace: str = DEFAULT_NAMESPACE, say: Say = lambda _: None
) -> Iterator[Target]:
    """The target from its start to its end. On AWS the stacks are deployed already, and the usual chain
    of credentials and region is followed; robots get names of the bench's own."""
    with tempfile.TemporaryDirectory(prefix="iort-bench-") as name:
        folder = Path(name)
        if kind == AWS:
            target = Target(AWS, Cloud(namespace=namespace), folder)
            try:
                yield target
            finally:
                say("removing the bench's robots")
                target.remove_robots()
            return
        with EmbeddedCloud(folder / "cloud", namespace=namespace, progress=say) as embedded:
            yield Target(EMBEDDED, embedded.cloud, folder, embedded)
