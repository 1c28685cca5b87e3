"""How rospy connects to a topic's publishers, mended: one attempt for each at a time, and each ends.

rospy starts a thread for each attempt. Two at once make two connections to one publisher, and the second ends
the first, with the messages that are on their way. An attempt to reach a computer that is switched off never
ends, while the node begins another one every few seconds.
"""

from __future__ import annotations

import importlib
import threading
from typing import Any

from iort_agent.ros1 import master

# A busy publisher may take longer to answer than a master.
_TIMEOUT_S = 10.0


def mend(caller: str) -> None:
    """Let the rospy that is imported now connect so, as the node ``caller``."""
    handlers = importlib.import_module("rospy.impl.masterslave").ROSHandler
    topics = importlib.import_module("rospy.impl.registration").get_topic_manager
    lock, running = threading.Lock(), set()

    def connect(handler: Any, topic: str, uri: str) -> tuple[int, str, int]:
        attempt = topic, uri
        with lock:
            if attempt in running:
                return 1, "another attempt runs", 0
            running.add(attempt)
        try:
            subscriber = topics().get_subscriber_impl(topic)
            if subscriber is None or subscriber.has_connection(uri):
                return 1, "nothing to do", 0
            protocols = [one for each in handler.protocol_handlers for one in each.get_supported()]
            status, told, chosen = master.proxy(uri, _TIMEOUT_S).requestTopic(caller, topic, protocols)
            if status != 1 or not chosen:
                return 0, told, 0
            (protocol,) = (one for one in handler.protocol_handlers if one.supports(chosen[0]))
            made: tuple[int, str, int] = protocol.create_transport(topic, uri, chosen)
            return made
        finally:
            with lock:
                running.remove(attempt)

    handlers._connect_topic = connect  # noqa: SLF001 - rospy has no public name for it
