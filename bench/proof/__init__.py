"""The proof of the analysis: drives of simulated cars with known parameters and faults, and what is found."""
