"""Miners: what the samples of one drive tell. A miner is a function from a `Drive` to a `Mined`."""
