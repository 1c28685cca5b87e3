"""What miners and evaluation measure with: fits and intervals, distributions, signals."""
