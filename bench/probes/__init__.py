"""Probes: each tries one ability of the deployed stacks and returns what it saw, or raises."""
