"""The live page: its server, its settings, and what keeps it fresh."""
