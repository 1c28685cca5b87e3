"""What the live page asks and does, a file a subject; `index` has every answer by its name."""
