"""Where batches wait until the broker has acknowledged them, in memory or on disk."""
