"""Gaps of DynamoDB: the speed of a Query and of numbers."""
