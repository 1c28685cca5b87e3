"""What sets the checkout up, checks it and writes its generated pages: `python scripts/NAME.py` or `-m`."""
