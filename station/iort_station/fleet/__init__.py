"""Robots and what belongs to them: registry rows, claims, certificates, shadows, files."""
