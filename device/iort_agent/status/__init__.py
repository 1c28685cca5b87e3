"""The agent's status and report: their types, the socket that gives the status, and its text for a person.

Imports no other room.
"""
