"""What several functions use; nothing here has a handler."""
