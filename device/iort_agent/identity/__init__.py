"""The robot's certificate: how it is obtained, renewed and checked. It uses only common helpers."""
