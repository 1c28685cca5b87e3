"""Probes: each does one thing with the deployed stacks and says what it saw, or raises."""
