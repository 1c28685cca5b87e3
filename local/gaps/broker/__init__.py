"""Gaps of the MQTT broker: who is served, and on which port."""
