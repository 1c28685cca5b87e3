"""The live page: its server, files and configuration. It uses every room but the commands."""
