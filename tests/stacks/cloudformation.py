"""What CloudFormation knows of a resource: its name, and what may not be changed of it.

From the resources' own schemas, which come with cfn-lint.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cfnlint.schema.manager import PROVIDER_SCHEMA_MANAGER

# Not made by a service, but by a function of the stack or by nobody.
_NO_SCHEMA = ("Custom::", "AWS::CDK::")
# Of which there may be one only, although the identifier is AWS' own.
_ONE_OF = {
    "AWS::Lambda::EventSourceMapping": ("/properties/FunctionName", "/properties/EventSourceArn"),
    "AWS::SNS::Subscription": ("/properties/TopicArn", "/properties/Protocol", "/properties/Endpoint"),
}


def schema(kind: str) -> dict[str, Any]:
    """The schema of a resource's type."""
    return dict(PROVIDER_SCHEMA_MANAGER.get_resource_schema("us-east-1", kind).schema)


def has_schema(resource: dict[str, Any]) -> bool:
    return not resource["Type"].startswith(_NO_SCHEMA)


def values(resource: dict[str, Any], path: str) -> list[Any]:
    """What stands at a path of a schema, ``/properties/Tags/*/Key``; nothing where nothing stands."""
    found = [resource.get("Properties", {})]
    for step in path.split("/")[2:]:
        if step == "*":
            found = [one for value in found if isinstance(value, list) for one in value]
        else:
            found = [value[step] for value in found if isinstance(value, dict) and step in value]
    return found


def names(resource: dict[str, Any]) -> dict[str, Any]:
    """Path to value of the physical names that the template gives: what the identifier is, or the name
    that AWS makes an identifier of (a queue's address, a topic's ARN)."""
    kind = resource["Type"]
    named = f"{kind.split('::')[-1]}Name"
    own = list(schema(kind)["primaryIdentifier"])
    if not all(values(resource, path) for path in own):
        own = []
    own.append(f"/properties/{named}")
    for name, value in resource.get("Properties", {}).items():
        own += [f"/properties/{name}/{inner}" for inner in ("Name", named) if inner in _keys(value)]
    return {path: value for path in dict.fromkeys(own) for value in values(resource, path)}


def _keys(value: Any) -> set[str]:
    return set(value) if isinstance(value, dict) else set()


def identity(resource: dict[str, Any]) -> str | None:
    """Type and name of what has a name of ours, by which there can be one only."""
    if not has_schema(resource):
        return None
    kind = resource["Type"]
    given = {path: values(resource, path) for path in _ONE_OF.get(kind, ())} or names(resource)
    return f"{kind} {given}" if given else None


def given_once_for_all(resource: dict[str, Any]) -> dict[str, list[Any]]:
    """Path to values of what replaces the resource when it changes, or replaces it under a condition."""
    if not has_schema(resource):
        return {}
    known = schema(resource["Type"])
    paths: Iterator[str] = (
        path
        for kind in ("createOnlyProperties", "conditionalCreateOnlyProperties")
        for path in known.get(kind, [])
    )
    return {path: values(resource, path) for path in paths}


def is_replaced(old: dict[str, Any], new: dict[str, Any]) -> bool:
    """Whether a property changes that is given once for all."""
    return old["Type"] != new["Type"] or given_once_for_all(old) != given_once_for_all(new)
