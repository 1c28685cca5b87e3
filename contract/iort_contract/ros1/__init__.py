"""ROS 1 messages: what a definition says, a message as one flat sample, and batches that keep messages as
they were published. Standard library and the contract's limits only."""
