"""Commands for robots: register, configure, command, fetch files. They use `iort_station.fleet`."""
