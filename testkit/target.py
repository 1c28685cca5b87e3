"""The target of the measurements: an embedded cloud started for the bench, or a deployment on AWS."""

from __future__ import annotations

import io
import secrets
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.limits import DEFAULT_NAMESPACE
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import robots
from iort_station.page.page import load_keys
from iort_station.page.pubnub import Listener
from local.cloud import EmbeddedCloud

EMBEDDED, AWS = "embedded", "aws"
Say = Callable[[str], None]


@dataclass
class Target:
    """A deployment, with robots that are registered for the bench and removed after it.

    In an account, every name of this run ends with ``run``, so that items of an earlier run are not counted.
    ``destroy`` takes a deployment down that was made for this run, and returns what is left over of it.
    """

    kind: str
    cloud: Cloud
    folder: Path
    embedded: EmbeddedCloud | None = None
    run: str = ""
    destroy: Callable[[], list[str]] | None = None
    _robots: list[str] = field(default_factory=list)

    def name(self, base: str) -> str:
        """Return the name of a resource of the bench."""
        return f"{base}-{self.run}" if self.run else base

    def robot(self, base: str, **settings: Any) -> robots.Bundle:
        """Register a robot of that `name`; its agent's settings are ``settings``."""
        name = self.name(base)
        self._robots.append(name)
        return robots.add(self.cloud, name, out=self.folder / "robots", settings=settings)

    def listener(self, robot: str) -> Listener:
        """A subscriber of the robot's channel."""
        pubnub = load_keys(self.cloud)
        return Listener(
            robot=robot,
            namespace=self.cloud.namespace,
            **pubnub.reading(),
        )

    def remove_robots(self, say: Say) -> None:
        """Remove as many of the robots as possible; the data that they sent expires by itself."""
        while self._robots:
            name = self._robots.pop()
            try:
                robots.remove(self.cloud, name)
            except (StationError, BotoCoreError, ClientError) as error:
                say(f"{name} could not be removed; `iort robots remove {name}` tries again: {error}")


@contextmanager
def open_target(
    kind: str,
    *,
    namespace: str = DEFAULT_NAMESPACE,
    cloud: Cloud | None = None,
    say: Say = lambda _: None,
) -> Iterator[Target]:
    """Yield the target while it exists.

    On AWS the stacks are deployed already: those of ``cloud``, or of the usual credentials and region.
    """
    with tempfile.TemporaryDirectory(prefix="iort-bench-") as name:
        folder = Path(name)
        if kind == AWS:
            run = secrets.token_hex(3)
            target = Target(AWS, cloud or Cloud(namespace=namespace), folder, run=run)
            try:
                yield target
            finally:
                say("removing the bench's robots")
                target.remove_robots(say)
            return
        with EmbeddedCloud(folder / "cloud", namespace=namespace, progress=say) as embedded:
            yield Target(EMBEDDED, embedded.cloud, folder, embedded)


@contextmanager
def temporary_function(
    target: Target,
    name: str,
    source: str,
    *,
    memory_mb: int,
    timeout_s: int = 3,
    like: str = "Echo",
    variables: Mapping[str, str] | None = None,
) -> Iterator[str]:
    """Deploy a function with environment variables, yield its name, and delete it at the end.

    ``source`` defines `handler`. Runtime, role, architecture and log are those of the function ``like``.
    """
    client = target.cloud.client("lambda")
    whole = target.name(f"{target.cloud.namespace}-bench-{name}")
    model = target.cloud.output("processing", f"{like}Function")
    configuration = client.get_function_configuration(FunctionName=model)
    logging = configuration.get("LoggingConfig")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr(f"{name}.py", source)
    client.create_function(
        FunctionName=whole,
        Runtime=configuration["Runtime"],
        Role=configuration["Role"],
        Handler=f"{name}.handler",
        Architectures=configuration.get("Architectures", ["arm64"]),
        MemorySize=memory_mb,
        Timeout=timeout_s,
        LoggingConfig={"LogGroup": logging["LogGroup"]} if logging else {},
        Environment={"Variables": dict(variables or {})},
        Code={"ZipFile": packed.getvalue()},
    )
    try:
        client.get_waiter("function_active_v2").wait(FunctionName=whole)
        yield whole
    finally:
        client.delete_function(FunctionName=whole)


def configure(client: Any, function: str, **change: Any) -> None:
    """Change the function's configuration, and wait until it is in force."""
    updated = client.get_waiter("function_updated_v2")
    # An interrupt may have left the change before under way, and AWS refuses one meanwhile.
    updated.wait(FunctionName=function)
    client.update_function_configuration(FunctionName=function, **change)
    updated.wait(FunctionName=function)
