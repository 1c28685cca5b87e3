"""The resource of a request to a named shadow.

AWS: is thing/<thing>/<shadow>
  (https://docs.aws.amazon.com/iot/latest/developerguide/iot-action-resources.html).
ministack: takes the request for one about thing/<thing>.
Test: tests/local/test_gaps.py::test_a_request_about_a_named_shadow_names_it
Patch: local/patches/shadow_arn.patch
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.core import iam_actions

_REQUEST: tuple[Any, ...] = (
    "iot-data",
    "GET",
    "/things/car/shadow",
    {},
    b"",
    {"name": "one"},
    "eu-west-1",
    "000000000000",
)


def install() -> None:
    """Close the gap in this process."""
    iam_actions.extract_resource_arn = knowing_shadows(iam_actions.extract_resource_arn)


def is_open() -> bool:
    """Ask for the resource of a request."""
    return not iam_actions.extract_resource_arn(*_REQUEST).endswith(":thing/car/one")


def knowing_shadows(resource_arn: Callable[..., str]) -> Callable[..., str]:
    """The resource of a request, for a named shadow with its name."""

    @wraps(resource_arn)
    def extract(service: str, *request: Any) -> str:
        found = resource_arn(service, *request)
        path, query = request[1], request[4] or {}
        if service not in {"iot", "iot-data"} or not path.endswith("/shadow") or ":thing/" not in found:
            return found
        name = query.get("name") or ""
        name = name[0] if isinstance(name, list) else name
        return f"{found}/{name}" if name else found

    return extract
