"""A ROS 2 node asks the cloud: what tests/ros/test_asks.py holds over ROS 1 holds here, too."""

from tests.ros.test_asks import (  # noqa: F401 - collected here, with the graph of this folder
    test_a_node_calls_the_service_and_gets_the_answer,
    test_a_refusal_is_no_success_and_says_why,
    test_a_topic_takes_bodies_and_another_has_the_answers,
)
