"""The messages on the wire, one kind per file: encode, decode and check."""
