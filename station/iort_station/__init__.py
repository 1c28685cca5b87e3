"""The operator's station: what people use to watch the cars, ask what happened and take the data home."""
