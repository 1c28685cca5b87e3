"""What the verbs of the command line do. They may use every room; only `cli` uses them."""
