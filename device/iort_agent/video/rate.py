"""The bitrate that a viewer's network bears.

A viewer estimates it by the delays of packets, and says so (REMB). A network that drops what is too much,
instead of delaying it, shows itself by losses: above a tenth the bitrate falls, below a fiftieth it grows
again. A radio that loses some packets at any bitrate changes nothing."""

from __future__ import annotations

# As WebRTC's own senders do it.
_MANY_LOST, _FEW_LOST, _GROWTH = 0.1, 0.02, 1.08


class Rate:
    """A rate from ``min_bps`` to ``max_bps``; ``start_bps`` before the viewer has said anything."""

    def __init__(self, start_bps: float, min_bps: float, max_bps: float) -> None:
        self._min_bps, self._max_bps = min_bps, max_bps
        self._bound_bps = max_bps
        self._told_bps = start_bps

    def told(self, bps: float) -> None:
        """Note what the viewer says that it can take."""
        self._told_bps = bps

    def lost(self, share: float) -> None:
        """Note the share of packets that a report misses; the viewer makes one a second."""
        if share > _MANY_LOST:
            self._bound_bps = max(self._min_bps, self.bps() * (1 - share / 2))
        elif share < _FEW_LOST:
            self._bound_bps = min(self._max_bps, self._bound_bps * _GROWTH)

    def bps(self) -> float:
        """The bitrate now, in bit/s."""
        return max(self._min_bps, min(self._told_bps, self._bound_bps))
