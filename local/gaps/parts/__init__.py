"""Parts of gaps: a model of stream mappings, fair threads, points of metrics."""
