"""Scripts that set the checkout up, check it and write generated pages: `python scripts/NAME.py` or `-m`."""
