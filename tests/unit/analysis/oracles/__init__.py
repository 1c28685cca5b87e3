"""The analysis against published implementations of the same methods; the car knows none of them."""
