"""Lambda's runtime and architecture for the functions, shared by the stacks and scripts/layer.py."""

from __future__ import annotations

PYTHON = "3.13"
ARCHITECTURE = "arm64"
# uv's name: that Python's runtime is Amazon Linux 2023, which has glibc 2.34.
PLATFORM = "aarch64-manylinux_2_34"
