"""Commands for those who run a deployment. They use `iort_station.operations` and `iort_station.cost`."""
