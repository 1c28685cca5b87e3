"""An execution environment: starts a function under `awslambdaric`, sends events and measures it.

The runtime writes log records as frames to a pipe of Lambda, and the function prints to standard output.
Both are kept apart here, as in Lambda.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import queue
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.meters import usage
from tests.runtime.api import NEXT, Call, RuntimeApi, Services, served

_ANSWER_S = 60.0
REGION = "eu-west-1"
# boto3 and the client that runs the functions, each with its dependencies.
RUNTIME_PACKAGES = (
    *("boto3", "botocore", "dateutil", "jmespath", "s3transfer", "six", "urllib3"),
    *("awslambdaric", "runtime_client", "simplejson", "snapshot_restore_py"),
)
_FRAME = struct.Struct(">4sIQ")
_MB = 1024


class RuntimeFailedError(Exception):
    """The function did not start, or its runtime ended; the text has the runtime's output."""


@dataclass(frozen=True)
class Function:
    """A deployed function: the folder of its code, and its configuration."""

    name: str
    handler: str
    code: Path
    layer: Path | None
    memory_mb: int
    timeout_s: int
    environment: Mapping[str, str]
    log_format: str
    log_level: str


@dataclass
class Environment:
    """A started function. ``start_cpu_ms`` is the processor time of all threads until the first request for
    an event. ``printed`` and ``logged`` are complete when the process has ended."""

    api: RuntimeApi
    services: Services
    process: subprocess.Popen[bytes]
    start_cpu_ms: float = 0.0
    start_ms: float = 0.0
    printed: list[str] = field(default_factory=list)
    logged: list[str] = field(default_factory=list)

    def wait_for_start(self, began: float) -> None:
        """Wait until the runtime asks for its first event; ``began`` is the monotonic time of the start.

        Raises `RuntimeFailedError` if it ends before.
        """
        first = self._call()
        if first.kind != NEXT:
            raise RuntimeFailedError(str(first.document))
        self.start_ms = (time.monotonic() - began) * 1000
        self.start_cpu_ms = self.cpu_ms()

    def invoke(self, event: dict[str, Any]) -> Call:
        """Send an event, wait until the runtime asks for the next one, and return the answer.

        Every table has the items of the event's stream records.
        """
        records = event.get("Records", [])
        self.services.items = [one["dynamodb"]["NewImage"] for one in records if "dynamodb" in one]
        self.api.send(event)
        answer = self._call()
        assert self._call().kind == NEXT
        return answer

    def cpu_ms(self) -> float:
        """Return the processor time so far."""
        return usage.spent_ms({}, usage.threads_ns([self.process.pid]))

    def peak_mb(self) -> float:
        """Return its peak resident memory."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) / _MB

    def _call(self) -> Call:
        deadline = time.monotonic() + _ANSWER_S
        while time.monotonic() < deadline:
            with contextlib.suppress(queue.Empty):
                return self.api.calls.get(timeout=0.1)
            if self.process.poll() is not None:
                raise RuntimeFailedError(f"the runtime ended with {self.process.returncode}")
        raise RuntimeFailedError(f"the runtime has said nothing for {_ANSWER_S:.0f} s")


@contextlib.contextmanager
def started(function: Function, folder: Path, *, python: str = sys.executable) -> Iterator[Environment]:
    """Run the function in an environment of its own while the block lasts; its files are in ``folder``.

    Raises `RuntimeFailedError` if it does not start.
    """
    api, services = RuntimeApi(function.name, function.timeout_s), Services()
    own = folder / "runtime"
    link_runtime(own)
    printed, logged = folder / "printed", folder / "logged"
    with served(api, services) as address, printed.open("wb") as out, logged.open("wb") as log:
        began = time.monotonic()
        process = subprocess.Popen(
            # -S and -s: only the linked packages of this environment are on the path.
            [python, "-S", "-s", "-m", "awslambdaric", function.handler],
            cwd=function.code,
            env=_variables(function, address, own, log.fileno()),
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            pass_fds=[log.fileno()],
        )
        found = Environment(api, services, process)
        try:
            found.wait_for_start(began)
            yield found
        finally:
            process.kill()
            process.wait()
            found.printed += printed.read_text().splitlines()
            found.logged += frames(logged.read_bytes())


def frames(data: bytes) -> list[str]:
    """Yield the messages of a runtime's output; each follows its type, length and time."""
    found = []
    while data:
        _, length, _ = _FRAME.unpack(data[: _FRAME.size])
        found.append(data[_FRAME.size : _FRAME.size + length].decode())
        data = data[_FRAME.size + length :]
    return found


def link_runtime(folder: Path) -> list[Path]:
    """Link the packages that AWS' Python has, from this environment; return their folders and files.

    Raises `RuntimeFailedError` if one is not installed.
    """
    folder.mkdir()
    linked = []
    for name in RUNTIME_PACKAGES:
        spec = importlib.util.find_spec(name)
        if spec is None or spec.origin is None:
            raise RuntimeFailedError(f"{name} is not there: run `make setup`")
        origin = Path(spec.origin)
        origin = origin.parent if origin.name == "__init__.py" else origin
        (folder / origin.name).symlink_to(origin)
        linked.append(origin)
    return linked


def _variables(function: Function, address: str, own: Path, log: int) -> dict[str, str]:
    """Return Lambda's "Defined runtime environment variables", with keys that no AWS accepts."""
    path = [own] if function.layer is None else [function.layer / "python", own]
    return {
        **function.environment,
        "PATH": os.defpath,
        "HOME": str(own),
        "LANG": "en_US.UTF-8",
        "TZ": ":UTC",
        "PYTHONPATH": os.pathsep.join(map(str, path)),
        # The function's folders cannot be written on AWS.
        "PYTHONDONTWRITEBYTECODE": "1",
        "AWS_LAMBDA_RUNTIME_API": address,
        "AWS_LAMBDA_INITIALIZATION_TYPE": "on-demand",
        "AWS_LAMBDA_FUNCTION_NAME": function.name,
        "AWS_LAMBDA_FUNCTION_VERSION": "$LATEST",
        "AWS_LAMBDA_FUNCTION_MEMORY_SIZE": str(function.memory_mb),
        "AWS_LAMBDA_LOG_FORMAT": function.log_format,
        "AWS_LAMBDA_LOG_LEVEL": function.log_level,
        "_LAMBDA_TELEMETRY_LOG_FD": str(log),
        "AWS_REGION": REGION,
        "AWS_DEFAULT_REGION": REGION,
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_ENDPOINT_URL": f"http://{address}",
        "AWS_EC2_METADATA_DISABLED": "true",
    }
