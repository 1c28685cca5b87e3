"""The archive's files: an hour of a stream as Parquet and back, losslessly. Only this room needs pyarrow."""
