"""The analysis of what robots recorded: pure functions over arrays, on the contract and numpy only."""
