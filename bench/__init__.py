"""Measures what the README promises, each figure beside its floor in the same run.

`python -m bench.run` measures sections, which `bench.sections` declares, and writes their report. Only
scripts/ and tests/ import the bench.
"""
