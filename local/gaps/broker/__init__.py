"""Gaps of the MQTT broker: listeners, sessions, certificates, message size."""
