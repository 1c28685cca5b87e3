"""The floors: the least that does the same job, measured beside ours. They use no other room of the bench."""
