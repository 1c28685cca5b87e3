"""What the analysis can say of a drive: parameters of a car, and kinds of findings."""
