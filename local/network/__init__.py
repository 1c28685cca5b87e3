"""What a kept cloud shows of itself in a network: where it listens, and the door to the files."""
