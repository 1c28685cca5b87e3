"""One typed entry for each thing that several parts must know. It uses names and limits, and no messages."""
