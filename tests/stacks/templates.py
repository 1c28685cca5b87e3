"""Templates as comparable text: intrinsic functions written out, hashes removed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.conftest import Synthesized

_HASH = re.compile(r"[0-9A-F]{8}$")


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
