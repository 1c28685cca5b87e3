"""Drives: found in the recordings, cleaned, and brought onto one clock."""
