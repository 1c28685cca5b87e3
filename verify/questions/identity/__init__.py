"""Questions about certificates, and how a robot gets its first one."""
