"""The archive's writer: what is due, an hour, a day, and expiries that are put off."""
