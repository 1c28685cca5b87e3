"""The cost model: prices, the usage of a fleet, its bill, and AWS' quotas. It uses the contract."""
