"""The cost model: prices, the usage of a fleet, its bill, and AWS' quotas. It uses the contract,
`iort_station.cloud` and CloudWatch's dashboards of `iort_station.operations`."""
