"""The analysis of what robots recorded: pure functions over arrays, on the contract, numpy and, for the archive, pyarrow."""
