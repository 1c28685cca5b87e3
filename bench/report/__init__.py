"""The report: results with their statistics and pictures, the figures of the thesis, and the files."""
