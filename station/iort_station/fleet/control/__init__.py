"""What an operator makes a robot do: commands, driving, the emergency stop, settings by the shadow."""
