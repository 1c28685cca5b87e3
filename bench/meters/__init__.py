"""The meters: each measures one thing, such as processor time, a round trip or an invocation."""
