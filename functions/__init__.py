"""The Lambda functions, one effect a file. The asset holds this package and iort_contract, nothing else."""
