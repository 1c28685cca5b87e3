"""A VESC itself, on its serial line."""
