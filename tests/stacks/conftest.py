from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Synthesized
from tests.stacks.templates import Reader, layers


@pytest.fixture(scope="session")
def reader(synthesized: Synthesized) -> Reader:
    return Reader(synthesized)


@pytest.fixture(scope="session")
def alarms(synthesized: Synthesized) -> dict[str, dict[str, Any]]:
    """Every alarm by its name, without the deployment's."""
    found = synthesized.resources("AWS::CloudWatch::Alarm").values()
    return {alarm["AlarmName"].removeprefix("iort-"): alarm for alarm in found}


@dataclass(frozen=True)
class Deployment:
    """The app with some settings: its folder, and the templates by stack name."""

    folder: Path
    templates: dict[str, dict[str, Any]]


@pytest.fixture(scope="session")
def deployment(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Deployment]:
    """The app with these settings, synthesized once each."""
    from aws_cdk import App

    from app import build
    from stacks.settings import Settings

    layer = tmp_path_factory.mktemp("layer")
    made: dict[str, Deployment] = {}
    (layer / "nothing.py").touch()

    def synthesized(**given: Any) -> Deployment:
        key = repr(sorted(given.items()))
        if key not in made:
            app = App(outdir=str(tmp_path_factory.mktemp("cdk.out")))
            build(app, Settings(**layers(layer), **given))
            stacks = app.synth().stacks
            made[key] = Deployment(Path(app.outdir), {stack.stack_name: stack.template for stack in stacks})
        return made[key]

    return synthesized
