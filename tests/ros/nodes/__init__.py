"""Nodes of a ROS graph, each in its own process under ROS' Python."""

import sys


def say(line: str) -> None:
    """Write a line at once; print writes the newline separately, so two threads' lines would mix."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
