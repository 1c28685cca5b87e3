"""A rospy publisher of a made-up type, in its own process: `publisher.py NAME TOPIC TYPE RATE ...`.

It sends values of ``field`` that count up, and prints ``ready`` when a subscriber is connected. The line
``quit`` on standard input ends it.
"""

# ruff: noqa: T201 - standard output goes to the test that started it

import argparse
import sys
import threading
import time
from pathlib import Path

import genpy.dynamic
import rospy

parser = argparse.ArgumentParser()
parser.add_argument("name")
parser.add_argument("topic")
parser.add_argument("type")
parser.add_argument("definition", help="file with the full text of the definition")
parser.add_argument("--rate", type=float, default=50)
parser.add_argument("--start", type=int, default=0, help="the first value of the counter")
parser.add_argument("--count", type=int, default=0, help="stop counting after so many")
parser.add_argument("--stamp", default="now", help="now, or seconds since the epoch")
parser.add_argument("--latch", action="store_true", help="repeat the last message to who connects")
parser.add_argument("--field", required=True, help="dotted path of the field that counts")
options = parser.parse_args()

text = Path(options.definition).read_text()
Class = genpy.dynamic.generate_dynamic(options.type, text)[options.type]
rospy.init_node(options.name, disable_signals=True)
publisher = rospy.Publisher(options.topic, Class, queue_size=1000, tcp_nodelay=True, latch=options.latch)
stop = threading.Event()


def listen():
    for line in sys.stdin:
        if line.strip() == "quit":
            break
    stop.set()


threading.Thread(target=listen, daemon=True).start()
while publisher.get_num_connections() == 0 and not stop.is_set():
    stop.wait(0.01)
print("ready", flush=True)

message, n, began = Class(), 0, time.monotonic()
target = message
*path, last = options.field.split(".")
for name in path:
    target = getattr(target, name)
while not stop.is_set():
    if options.count and n >= options.count:
        stop.wait()
        break
    setattr(target, last, options.start + n)
    if hasattr(message, "header"):
        now = time.time() if options.stamp == "now" else float(options.stamp)
        message.header.stamp = genpy.Time.from_sec(now)
        message.header.frame_id = "base_link"
    publisher.publish(message)
    n += 1
    stop.wait(max(0.0, began + n / options.rate - time.monotonic()))
print(f"sent {n}", flush=True)
rospy.signal_shutdown("done")
