"""Helpers for every room: configuration schema, logging, private files and the version. It uses no room."""
