"""The analysis of what robots recorded: pure functions over arrays. Only `archive` needs pyarrow."""
