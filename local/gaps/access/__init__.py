"""Gaps of IAM: the action and the resource that a request is checked for."""
