"""The functions as deployed: configuration from the templates, code and layer from the assets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from aws_cdk import App

from app import build
from stacks.settings import Settings
from tests.runtime.environment import Function


def functions(folder: Path, layer: Path) -> dict[str, Function]:
    """Return every function by its module's name, synthesized into ``folder`` with Lambda 1's ``layer``.

    The analysis has this machine's numpy and pyarrow in place of its layer for AWS' processors.
    """
    arrays, empty = folder / "arrays", folder / "empty"
    (arrays / "python").mkdir(parents=True)
    for name in ("numpy", "numpy.libs", "pyarrow"):
        (arrays / "python" / name).symlink_to(Path(np.__file__).parents[1] / name)
    empty.mkdir()
    folder /= "app"
    app = App(outdir=str(folder))
    build(app, Settings(layer=layer, analysis_layer=empty))
    found = {}
    for stack in app.synth().stacks:
        resources: dict[str, Any] = stack.template["Resources"]
        layers = {
            logical: _asset(folder, one["Properties"]["Content"])
            for logical, one in resources.items()
            if one["Type"] == "AWS::Lambda::LayerVersion"
        }
        for one in resources.values():
            # The CDK has functions of its own, in JavaScript.
            if one["Type"] == "AWS::Lambda::Function" and one["Properties"]["Handler"].startswith(
                "functions."
            ):
                made = _function(folder, one["Properties"], layers)
                of_analysis = made.layer is not None and not any(made.layer.iterdir())
                found[made.name] = replace(made, layer=arrays) if of_analysis else made
    return dict(sorted(found.items()))


def _function(folder: Path, properties: Mapping[str, Any], layers: Mapping[str, Path]) -> Function:
    logging = properties.get("LoggingConfig", {})
    named = [layers[layer["Ref"]] for layer in properties.get("Layers", [])]
    variables = properties.get("Environment", {}).get("Variables", {})
    return Function(
        name=properties["Handler"].split(".")[1],
        handler=properties["Handler"],
        code=_asset(folder, properties["Code"]),
        layer=named[0] if named else None,
        memory_mb=properties["MemorySize"],
        timeout_s=properties["Timeout"],
        environment={name: _text(name, value) for name, value in variables.items()},
        log_format=logging.get("LogFormat", "Text"),
        log_level=logging.get("ApplicationLogLevel", ""),
    )


def _text(name: str, value: Any) -> str:
    """Return a variable's value, or a placeholder for a value that only the deployment knows."""
    if isinstance(value, str):
        return value
    if name.endswith("_QUEUE"):
        return "https://sqs.eu-west-1.amazonaws.com/000000000000/queue"
    return name.lower().replace("_", "-")


def _asset(folder: Path, key: Mapping[str, Any]) -> Path:
    return folder / f"asset.{key['S3Key'].removesuffix('.zip')}"
