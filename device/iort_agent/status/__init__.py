"""The agent's reports about itself: accounts, metrics and the status socket. It uses every lane."""
