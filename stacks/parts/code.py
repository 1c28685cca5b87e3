"""The code of every function as one asset: functions/ beside the packages of contract and analysis."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import jsii
from aws_cdk import BundlingOptions, DockerImage, IgnoreMode, ILocalBundling
from aws_cdk import aws_lambda as lambda_

from stacks.settings import ROOT

# Exactly the files that a function imports; see the wiring tests.
FOLDERS = ("functions", "contract/iort_contract", "analysis/iort_analysis")
_CACHES = ("__pycache__", ".mypy_cache", ".ruff_cache")
_EXCLUDES = [
    *("/*", "!/functions"),
    *("!/contract", "/contract/*", "!/contract/iort_contract"),
    *("!/analysis", "/analysis/*", "!/analysis/iort_analysis"),
    *_CACHES,
]


def code() -> lambda_.Code:
    """The asset; its hash is the folders' hash."""
    # The image is never used, since copying always works here.
    bundling = BundlingOptions(image=DockerImage.from_registry("scratch"), local=_SideBySide())
    return lambda_.Code.from_asset(
        str(ROOT), exclude=_EXCLUDES, ignore_mode=IgnoreMode.GIT, bundling=bundling
    )


@jsii.implements(ILocalBundling)
class _SideBySide:
    """Copies the folders instead of building in a container."""

    def try_bundle(self, output_dir: str, *_options: Any, **_more: Any) -> bool:
        for folder in FOLDERS:
            source = ROOT / folder
            shutil.copytree(source, Path(output_dir) / source.name, ignore=shutil.ignore_patterns(*_CACHES))
        return True
