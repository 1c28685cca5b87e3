"""The version of the installed agent."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def agent_version() -> str:
    """The version of the distribution iort-agent; a text that says so if it is not installed."""
    try:
        return version("iort-agent")
    except PackageNotFoundError:
        return "run from a checkout"
