"""Gaps of DynamoDB and SQS: speed of a Query, messages lost."""
