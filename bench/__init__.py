"""Measures what the README promises, each figure beside its floor in the same run."""
