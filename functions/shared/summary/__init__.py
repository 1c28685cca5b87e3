"""How Lambda 2 and `later` make a robot's seconds from its batches. No other function uses it."""
