"""The commands other than `run`. A verb may use every room."""
