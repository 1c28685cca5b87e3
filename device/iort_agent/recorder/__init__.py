"""The event recorder: a ring of all messages on disk, and what is kept of it when a trigger fires. It uses
sources and files, and no lane: a recorder that fails costs neither samples nor stops."""
