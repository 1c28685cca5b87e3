"""Encoding of numeric columns in a batch, and limits on the cost of decoding."""
