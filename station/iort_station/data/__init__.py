"""What the cars have recorded, as numpy columns or a pandas frame: what a notebook imports."""
