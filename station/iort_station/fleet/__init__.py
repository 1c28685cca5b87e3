"""Robots and what belongs to them. It uses the contract and `iort_station.cloud`."""
