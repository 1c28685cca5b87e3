"""The commands of `iort`, a subject a file; station/cli.py puts them together."""
