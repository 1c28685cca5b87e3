"""ROS 1 messages: definitions, messages as flat samples, and batches that keep messages as published. It uses
only the standard library and the contract's limits."""
