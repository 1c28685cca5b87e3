"""Samples as arrays: blocks, and the decoding of stored batches into them."""
