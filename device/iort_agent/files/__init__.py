"""Uploads of finished files over signed addresses. It uses the connection."""
