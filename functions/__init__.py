"""What runs in Lambda, one effect a file. The asset holds this package and contract/, nothing else."""
