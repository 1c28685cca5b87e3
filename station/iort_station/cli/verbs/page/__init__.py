"""Commands for live data: the page, its site, the terminal. They use `iort_station.page`."""
