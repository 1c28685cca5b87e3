"""Gaps of AWS IoT rules: SQL and actions."""
