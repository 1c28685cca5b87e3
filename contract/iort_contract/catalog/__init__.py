"""What the system knows of its data, each entry once: streams, fields, units, derived fields, rules, metrics.

Uses the messages and everything below them.
"""
