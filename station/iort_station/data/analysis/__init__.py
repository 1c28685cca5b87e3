"""What the analysis says of drives: findings, a car's calibration, laps."""
