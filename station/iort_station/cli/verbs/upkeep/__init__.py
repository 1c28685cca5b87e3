"""Commands for the machine that keeps a cloud. They use `iort_station.upkeep`."""
