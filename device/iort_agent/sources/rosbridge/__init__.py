"""ROS topics over a rosbridge server: the connection, the structures of messages, and the source."""
