"""What the steps of the state machine `analysis` share: recordings, and what a step keeps for the next."""
