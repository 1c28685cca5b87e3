"""The app synthesized, kept in build/ until an input changes; and templates as comparable text: intrinsic
functions written out, hashes removed."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from local.deployment import ROOT, sources
from local.emulator.package import artifact

_HASH = re.compile(r"[0-9A-F]{8}$")


@dataclass(frozen=True)
class Synthesized:
    """The app as deployed: a template for each stack, the folder with the assets, the stacks with termination
    protection, and the paths of acknowledged findings of the checkers."""

    namespace: str

    folder: Path
    templates: Mapping[str, dict[str, Any]]
    protected: set[str]
    acknowledged: set[str]

    @property
    def stacks(self) -> dict[str, dict[str, Any]]:
        """The templates by the stacks' whole names."""
        return {f"{self.namespace}-{noun}": template for noun, template in self.templates.items()}

    def resources(self, kind: str, stack: str | None = None) -> dict[str, dict[str, Any]]:
        """Return logical id -> properties for every resource of a type."""
        return {
            name: resource.get("Properties", {})
            for noun, template in self.templates.items()
            for name, resource in template["Resources"].items()
            if resource["Type"] == kind and stack in (None, noun)
        }

    def asset(self, key: dict[str, Any]) -> Path:
        """Return the source folder of a resource's S3Key."""
        return self.folder / f"asset.{key['S3Key'].removesuffix('.zip')}"


def synthesize(**given: Any) -> Synthesized:
    """The app with these settings."""
    return _synthesized(json.dumps(given, sort_keys=True))


@cache
def _synthesized(settings: str) -> Synthesized:
    folder = ROOT / "build" / "templates" / hashlib.sha256(settings.encode()).hexdigest()[:8]
    made = artifact(
        folder, settings, [*sources(ROOT), Path(__file__)], lambda into: _synthesize(into, settings)
    )
    facts = json.loads((made / "facts.json").read_text())
    namespace = facts["namespace"]
    templates = {
        noun: json.loads((made / f"{namespace}-{noun}.template.json").read_text()) for noun in facts["stacks"]
    }
    return Synthesized(namespace, made, templates, set(facts["protected"]), set(facts["acknowledged"]))


def _synthesize(into: Path, settings: str) -> None:
    # Imported here, because the CDK takes seconds to load.
    from aws_cdk import App

    from app import build
    from stacks.settings import Settings

    layer = into.with_name("layer") / "python"
    layer.mkdir(parents=True, exist_ok=True)
    (layer / "nothing.py").touch()
    read = Settings(**layers(layer.parent), **json.loads(settings))
    app = App(outdir=str(into))
    acknowledged = build(app, read)
    nouns = {one.stack_name.removeprefix(f"{read.namespace}-"): one for one in app.synth().stacks}
    facts = {
        "namespace": read.namespace,
        "stacks": list(nouns),
        "protected": [noun for noun, one in nouns.items() if one.termination_protection],
        "acknowledged": sorted({one.path for one in acknowledged}),
    }
    (into / "facts.json").write_text(json.dumps(facts))


def name(logical_id: str) -> str:
    """A logical id without the CDK's hash at its end."""
    return _HASH.sub("", logical_id)


def qualified(synthesized: Synthesized, kind: str) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """Name, stack, logical id and properties of every resource of a type; names of ingest have the stack's
    before them, because two stacks have a LiveRole."""
    for stack in synthesized.templates:
        for logical_id, properties in synthesized.resources(kind, stack).items():
            yield ("ingest/" if stack == "ingest" else "") + name(logical_id), stack, logical_id, properties


class Reader:
    """Reads values of a synthesized app; an import is read as the other stack's export."""

    def __init__(self, synthesized: Synthesized) -> None:
        self.exports = {
            output["Export"]["Name"]: output["Value"]
            for template in synthesized.templates.values()
            for output in template.get("Outputs", {}).values()
            if "Export" in output
        }

    def text(self, value: Any) -> str:
        """``arn:${AWS::Partition}:sqs:...``, ``Batches.Arn`` for an attribute, ``Live`` for a reference."""
        match value:
            case str():
                return value
            case {"Fn::Join": [separator, parts]}:
                return separator.join(map(self.text, parts))
            case {"Fn::GetAtt": [logical_id, attribute]}:
                return f"{name(logical_id)}.{attribute}"
            case {"Ref": str() as ref}:
                return "${" + ref + "}" if ref.startswith("AWS::") else name(ref)
            case {"Fn::ImportValue": export}:
                return self.text(self.exports[export])
        raise AssertionError(f"no text for {value}")

    def texts(self, value: Any) -> list[str]:
        return [self.text(one) for one in (value if isinstance(value, list) else [value])]


def layers(folder: Path) -> dict[str, Any]:
    """The settings that use a folder for every layer."""
    return {"layer": str(folder), "analysis_layer": str(folder)}


# CloudFormation's schemas: a resource's names and its properties that cannot be changed in place.
#
# The schemas come with cfn-lint.

# Not made by a service, but by a function of the stack, or not made at all.
_NO_SCHEMA = ("Custom::", "AWS::CDK::")
# Only one may exist, although AWS chooses the identifier.
_ONE_OF = {
    "AWS::Lambda::EventSourceMapping": ("/properties/FunctionName", "/properties/EventSourceArn"),
    "AWS::SNS::Subscription": ("/properties/TopicArn", "/properties/Protocol", "/properties/Endpoint"),
}


def schema(kind: str) -> dict[str, Any]:
    """The schema of a resource's type."""
    # Imported here, because cfn-lint takes a second to load.
    from cfnlint.schema.manager import PROVIDER_SCHEMA_MANAGER

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
