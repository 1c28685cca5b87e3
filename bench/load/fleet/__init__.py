"""Many robots at once: their load in a process of its own, a run against a cloud, and its figures."""
