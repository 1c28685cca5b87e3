"""The robot's certificate: how it is got, renewed and checked."""
