"""The questions that a robot may ask: a module for each, by its name in the catalogue, with its ``work``."""
