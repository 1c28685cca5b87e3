"""The command `iort`: its options, its verbs and how answers are printed."""
