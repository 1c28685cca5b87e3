"""The cost model: what is billed, at which price. Pure but for the price list."""
