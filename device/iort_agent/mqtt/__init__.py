"""The connection to the broker: reconnects, subscriptions and its rate limiter. It uses identity."""
