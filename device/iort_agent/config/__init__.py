"""car.yaml, read once into frozen dataclasses. Each room has its section; `file` collects them."""
