"""The kept cloud on trial: killed at random moments, and through a week on a clock that runs fast."""
