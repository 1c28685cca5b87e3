"""Third-party code of functions, as layers."""

from __future__ import annotations

from aws_cdk import aws_lambda as lambda_

from stacks.parts.base import PlatformStack
from stacks.parts.function import ARCHITECTURE, RUNTIME


def arrays(stack: PlatformStack) -> list[lambda_.ILayerVersion]:
    """The arrays of numpy and pyarrow, for functions that archive or analyse; call it once a stack.

    None on the embedded cloud: its functions run on this machine and see the packages of .venv.
    """
    if stack.settings.embedded:
        return []
    code = lambda_.Code.from_asset(str(stack.settings.analysis_layer))
    made = lambda_.LayerVersion(
        stack,
        "Arrays",
        code=code,
        compatible_runtimes=[RUNTIME],
        compatible_architectures=[ARCHITECTURE],
    )
    return [made]
