"""Helpers for every room: configuration schema, status types, logs, private files. It uses no other room."""
