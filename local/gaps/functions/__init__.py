"""Gaps of AWS Lambda: asynchronous events, stream mappings, logs."""
