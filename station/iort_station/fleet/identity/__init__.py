"""Who a robot is to the broker: certificates and their rotation, claims, and the bundle for the robot."""
