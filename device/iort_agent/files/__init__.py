"""Uploads of finished files by signed addresses."""
