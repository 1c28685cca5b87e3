"""What the embedded cloud keeps: a ledger in SQLite, and the services that have their state in it.

It wraps private functions of ministack, which is pinned, as local/emulator/fixes does.
"""
