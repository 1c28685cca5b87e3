"""Questions about messages: topic rules, what they forward, the broker, and the live lane."""
