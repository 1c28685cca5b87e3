"""The analysis of what robots recorded: pure functions over arrays. Only `archive` needs pyarrow."""

from __future__ import annotations


class AnalysisError(Exception):
    """The root of the package's exceptions."""


class NoResultError(AnalysisError):
    """A drive that does not tell a parameter; the text is the reason."""


class ArchiveError(AnalysisError):
    """An object of the archive that is missing or damaged; the text says which."""
