"""Moves robots from one deployment into another: planned, copied, and compared. A module for each thing that
moves.

Nothing is removed from the source. What the target has already stays, so an interrupted move goes on, and a
repeated one copies what is new.
"""
