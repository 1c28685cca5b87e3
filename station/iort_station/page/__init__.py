"""The live page: its server, answers, configuration and listener. It uses every room but the commands."""
