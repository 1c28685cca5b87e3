"""The archive's files: an hour of a stream as Parquet and back, without loss. The only room that needs pyarrow."""
