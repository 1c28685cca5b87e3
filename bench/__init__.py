"""Measures what the README promises, each figure beside its floor in the same run.

A module at this level is a command, or all commands share it. The bench may import every other package of the
repository; only verify/, scripts/ and tests/ import the bench.
"""
