"""A Lambda function that exists only while a measurement needs it."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager

from bench.target import Target


@contextmanager
def temporary_function(
    target: Target, name: str, source: str, *, memory_mb: int, timeout_s: int = 3, like: str = "Echo"
) -> Iterator[str]:
    """Deploy a function, yield its name, and delete it at the end.

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
        Code={"ZipFile": packed.getvalue()},
    )
    try:
        client.get_waiter("function_active_v2").wait(FunctionName=whole)
        yield whole
    finally:
        client.delete_function(FunctionName=whole)
