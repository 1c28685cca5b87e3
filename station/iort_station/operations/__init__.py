"""What an operator does with stored data: audit, trace, quarantine, replay, recompute, CloudWatch. It uses
data, fleet and `iort_station.cloud`."""
