"""The deployment's parameters, read once from the CDK context."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aws_cdk import App

from contract import DEFAULT_NAMESPACE, VESC_FIELDS, VESC_STREAM, ContractError, check_namespace

ROOT = Path(__file__).resolve().parent.parent


class SettingsError(ValueError):
    """A context value that the stacks cannot be built with; the text names key, value and what is allowed."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What may differ between two deployments of the same stacks.

    ``namespace`` prefixes topics, rules and stacks; ``retention_days`` is how long telemetry and
    summaries are kept; ``files_days`` is how long uploaded files are (0: for good);
    ``live_concurrency`` bounds Lambda 1 (0 reserves nothing, for accounts whose concurrency limit is
    too low to reserve from); ``live_fields`` maps stream to the fields that go to the dashboard;
    ``layer`` is the folder of Lambda 1's third-party code; ``embedded`` is true for the embedded
    cloud, which is deployed with the caller's own credentials.
    """

    namespace: str = DEFAULT_NAMESPACE
    retention_days: int = 90
    files_days: int = 0
    live_concurrency: int = 5
    live_fields: Mapping[str, list[str]] = field(default_factory=lambda: {VESC_STREAM: list(VESC_FIELDS)})
    layer: Path = ROOT / "build" / "layer" / "lambda"
    embedded: bool = False

    @classmethod
    def from_context(cls, app: App) -> Settings:
        """Read ``-c key=value`` and cdk.json; raises `SettingsError` for a value that is not allowed."""
        given: dict[str, Any] = {}
        if (namespace := app.node.try_get_context("namespace")) is not None:
            try:
                given["namespace"] = check_namespace(namespace)
            except ContractError as error:
                raise SettingsError(f"context {error}") from error
        whole = (("retention_days", 1, 3650), ("files_days", 0, 3650), ("live_concurrency", 0, 1000))
        for key, low, high in whole:
            if (value := app.node.try_get_context(key)) is not None:
                given[key] = _integer(key, value, low, high)
        if (layer := app.node.try_get_context("layer")) is not None:
            given["layer"] = ROOT / str(layer)
        if (embedded := app.node.try_get_context("embedded")) is not None:
            given["embedded"] = _boolean("embedded", embedded)
        settings = cls(**given)
        if not settings.layer.is_dir():
            raise SettingsError(f"layer {settings.layer} is not there: run `make layer`")
        return settings


def _integer(key: str, value: Any, low: int, high: int) -> int:
    # The CDK CLI gives every -c as text, cdk.json a number of either kind.
    text = str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)
    if not text.isdecimal() or not low <= int(text) <= high:
        raise SettingsError(f"context {key} = {value!r}: allowed is a whole number from {low} to {high}")
    return int(text)


def _boolean(key: str, value: Any) -> bool:
    if str(value).lower() not in ("true", "false"):
        raise SettingsError(f"context {key} = {value!r}: allowed is true or false")
    return str(value).lower() == "true"
