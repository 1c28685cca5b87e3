"""The questions of robots: a module for each, by its name in the catalogue, with its ``work``; and what they
share."""
