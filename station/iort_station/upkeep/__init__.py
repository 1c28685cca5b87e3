"""The upkeep of a cloud that one machine keeps: what its doctor finds, its backups. It may use operations."""
