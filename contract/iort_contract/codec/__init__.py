"""How columns of numbers are written in a batch, and what reading one may cost."""
