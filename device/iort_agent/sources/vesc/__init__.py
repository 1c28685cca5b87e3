"""A VESC itself: its serial line, and the logs of VESC Tool."""
