"""The commands of `iort`, a subject a file; station/iort_station/cli/main.py puts them together."""
