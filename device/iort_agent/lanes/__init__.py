"""From samples to messages: batches, live samples and pings, within what the broker allows."""
