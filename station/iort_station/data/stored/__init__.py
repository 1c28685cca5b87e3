"""A stream's batches as they are stored: in the tables, in the archive, or in both."""
