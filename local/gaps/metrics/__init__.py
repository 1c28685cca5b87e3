"""Gaps of CloudWatch: metrics that nobody records, SEARCH, alarms."""
