"""Robots and what belongs to them: registry rows, claims, certificates, shadows, files. It uses the contract
and `iort_station.cloud`."""
