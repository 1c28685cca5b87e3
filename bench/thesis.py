"""The figures of the KTH thesis of 2018, shown beside our own: its tables 6.5 and 6.6.

"A Practical Approach of an Internet of Robotic Things Platform": a car with ROS in Stockholm, AWS in Dublin,
a ping of 50 ms. The round trips of its table 6.4 are in `local.figures`."""

# Between its car and its cloud.
PING_MS = 50
# Table 6.5: an invocation, and a cycle of the ROS node.
LAMBDA_1, LAMBDA_2 = "10 - 15 ms (256 MB)", "12 ms (128 MB)"
NODE_CYCLE_MS = 2
# Table 6.6: 14,368 points; in Lambda with 512 MB, its fastest.
QUERY_ON_PREMISES, SCAN_ON_PREMISES = "6.1 s", "14.1 s"
QUERY_IN_LAMBDA, SCAN_IN_LAMBDA = "5.5 s (512 MB)", "12.9 s (512 MB)"
