"""The messages on the wire, a kind a file: each is encoded, decoded and checked here."""
