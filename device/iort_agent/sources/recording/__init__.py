"""Recordings as a source: bags and VESC Tool logs, the player, a look into them for `iort-agent check`."""
