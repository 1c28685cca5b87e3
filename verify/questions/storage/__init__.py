"""Questions about what is kept: tables and their streams, files, the quarantine."""
