"""car.yaml, read once into frozen dataclasses, and the settings that change while the agent runs."""
