"""The cloud, one noun a file. app.py builds the stacks and passes objects from one to the next."""
