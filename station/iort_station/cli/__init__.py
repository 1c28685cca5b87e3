"""The command `iort`: its options, its commands in verbs/, tables and plots. It may use every other room."""
