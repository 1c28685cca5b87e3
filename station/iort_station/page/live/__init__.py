"""Listens to live messages, at PubNub or at the broker, and keeps the newest of every robot."""
