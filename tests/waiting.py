"""The time that tests wait for an event."""

from __future__ import annotations

# It only ends a test that hangs: CI's machine is shared, and may stand still for a minute.
GUARD_S = 240
