"""Publishes blue images, 30 a second: `images.py ROS TOPIC`. It says the number of its subscribers at each
change. An input line ends it."""

import sys
import threading

from testkit.publishing import say

WIDTH, HEIGHT, BLUE = 64, 48, bytes((255, 0, 0))
_FIELDS = {
    "height": HEIGHT,
    "width": WIDTH,
    "encoding": "bgr8",
    "step": 3 * WIDTH,
    "data": BLUE * (WIDTH * HEIGHT),
}
_DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
"""


def ros1(topic):
    """A message that is stamped, and two functions: publish it, count the subscribers."""
    import genpy.dynamic
    import rospy

    kind = "sensor_msgs/Image"
    message = genpy.dynamic.generate_dynamic(kind, _DEFINITION)[kind](**_FIELDS)
    rospy.init_node("camera", disable_signals=True)
    publisher = rospy.Publisher(topic, type(message), queue_size=1)

    def publish():
        message.header.stamp = rospy.Time.now()
        publisher.publish(message)

    return publish, publisher.get_num_connections


def ros2(topic):
    """As `ros1`."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Image

    rclpy.init(args=[])
    node = rclpy.create_node("camera")
    message = Image(**_FIELDS)
    publisher = node.create_publisher(Image, topic, qos_profile_sensor_data)

    def publish():
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)

    return publish, publisher.get_subscription_count


publish, subscribers = {"1": ros1, "2": ros2}[sys.argv[1]](sys.argv[2])
end, known = threading.Event(), None
threading.Thread(target=lambda: (sys.stdin.readline(), end.set()), daemon=True).start()
while not end.wait(1 / 30):
    publish()
    if subscribers() != known:
        known = subscribers()
        say(f"subscribers {known}")
