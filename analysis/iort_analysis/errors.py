"""The package's exceptions."""

from __future__ import annotations


class AnalysisError(Exception):
    """The root of the package's exceptions."""
