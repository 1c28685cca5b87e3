"""Commands that read recorded samples. They use `iort_station.data`."""
