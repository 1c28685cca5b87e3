"""Recordings played as if they were driven now."""
