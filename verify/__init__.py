"""Asks a deployment what the design rests on, `make verify-aws`; an instrument, which only tests import."""
