"""Helpers shared by several functions; no handlers here."""
