"""The cloud: one stack a file. `parts` is what several are made of, `checks` what every template
must hold.

app.py builds the stacks and passes objects from one to the next. They import the contract alone.
"""

from __future__ import annotations

# Lambda's runtime and architecture, for the stacks and scripts/layer.py.
PYTHON, ARCHITECTURE = "3.13", "arm64"
# uv's name: that Python's runtime is Amazon Linux 2023, which has glibc 2.34.
PLATFORM = "aarch64-manylinux_2_34"
