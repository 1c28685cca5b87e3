"""The load that is measured: simulated cars, fleets, stored drives and the most expensive batches."""
