"""A ROS 1 graph and its publishers; the publishers and their messages run under a Python that has rospy."""
