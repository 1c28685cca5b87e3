"""CloudFormation's schemas: a resource's names and its properties that cannot be changed in place.

The schemas come with cfn-lint.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cfnlint.schema.manager import PROVIDER_SCHEMA_MANAGER

# Not made by a service, but by a function of the stack, or not made at all.
_NO_SCHEMA = ("Custom::", "AWS::CDK::")
# Only one may exist, although AWS chooses the identifier.
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
    """The values at a schema's path, ``/properties/Tags/*/Key``; empty if the path does not exist."""
    found = [resource.get("Properties", {})]
    for step in path.split("/")[2:]:
        if step == "*":
            found = [one for value in found if isinstance(value, list) for one in value]
        else:
            found = [value[step] for value in found if isinstance(value, dict) and step in value]
    return found


def names(resource: dict[str, Any]) -> dict[str, Any]:
    """Path to value of the physical names that the template gives: the identifier itself, or the name
    from which AWS makes the identifier (a queue's address, a topic's ARN)."""
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
    """Type and name of a resource with a name of ours, which must be unique."""
    if not has_schema(resource):
        return None
    kind = resource["Type"]
    given = {path: values(resource, path) for path in _ONE_OF.get(kind, ())} or names(resource)
    return f"{kind} {given}" if given else None


def create_only(resource: dict[str, Any]) -> dict[str, list[Any]]:
    """Path to values of the properties whose change replaces the resource, always or conditionally."""
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
    """Whether a create-only property changes."""
    return old["Type"] != new["Type"] or create_only(old) != create_only(new)
