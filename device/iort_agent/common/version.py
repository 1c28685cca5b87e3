"""The version of the installed agent."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def agent_version() -> str:
    """The version of the distribution iort-agent, or that there is none."""
    try:
        return version("iort-agent")
    except PackageNotFoundError:
        return "run from a checkout"
