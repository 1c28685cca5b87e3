"""The floor of the live lane: a bare rospy subscriber that hands messages to a bare MQTT client.

    python -m bench.floors.mqtt_floor TOPIC EVERY PORT CERTIFICATE KEY CA MQTT_TOPIC

Publishes the bytes of every EVERY-th message unchanged. Ends after a line on its input.
"""

import itertools
import sys
import threading

import rospy
from awscrt import mqtt5
from awsiot import mqtt5_client_builder

from iort_agent.mqtt.client import send_at_once


def main() -> None:
    """Connect, subscribe, and pass messages on until a line on the input."""
    topic, every, port, certificate, key, ca, to = sys.argv[1:]
    connected, stopped, numbers = threading.Event(), threading.Event(), itertools.count()
    client = mqtt5_client_builder.mtls_from_path(
        certificate,
        key,
        endpoint="127.0.0.1",
        port=int(port),
        ca_filepath=ca,
        client_id="bench-floor",
        on_lifecycle_connection_success=lambda _: connected.set(),
        on_lifecycle_stopped=lambda _: stopped.set(),
    )
    client.start()
    if not connected.wait(20):
        raise TimeoutError("the bare client was not connected within 20 s")
    send_at_once(int(port))

    def take(message: rospy.AnyMsg) -> None:
        if next(numbers) % int(every) == 0:
            packet = mqtt5.PublishPacket(topic=to, payload=message._buff, qos=mqtt5.QoS.AT_MOST_ONCE)  # noqa: SLF001 - rospy names it so
            client.publish(packet)

    rospy.init_node("bench_mqtt_floor", disable_signals=True)
    rospy.Subscriber(topic, rospy.AnyMsg, take, tcp_nodelay=True)
    sys.stdin.readline()
    client.stop()
    stopped.wait(20)


main()
