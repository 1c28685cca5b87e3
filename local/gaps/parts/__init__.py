"""Parts of gaps: a model of stream mappings, fair threads, ordered partitions, points of metrics."""
