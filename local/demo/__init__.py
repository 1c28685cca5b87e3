"""`make demo`: a car drives through an embedded cloud that is thrown away."""
