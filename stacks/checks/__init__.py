"""What `make check` and the tests hold every template to. No stack is built here."""
