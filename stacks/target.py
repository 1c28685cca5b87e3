"""What Lambda runs the functions on: said once, for the stacks and for scripts/layer.py."""

from __future__ import annotations

PYTHON = "3.13"
ARCHITECTURE = "arm64"
# As uv names it: that Python's runtime is Amazon Linux 2023, which has glibc 2.34.
PLATFORM = "aarch64-manylinux_2_34"
