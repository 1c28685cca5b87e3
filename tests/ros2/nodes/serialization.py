"""Compares what the middleware reads and writes with the agent's decoder and writer, for messages of all
installed types: `serialization.py SEED MESSAGES`. It prints what differs, then the types it has compared."""

# ruff: noqa: T201 - standard output goes to the test that started it

import random
import sys

import rclpy
from rclpy.serialization import deserialize_message, serialize_message
from rosidl_runtime_py import get_interface_packages, get_message_interfaces

from iort_agent.ros import json_message, ros2_types
from iort_contract.messages.batch import Batch, encode_batch, messages_of
from iort_contract.ros.decode import stamp_ns
from iort_contract.ros.message import Messages, RosType
from tests.ros2.nodes.random_message import WORDS, Values
from tests.unit.contract.ros.ros_values import view_of


def plain(value):
    """A message as JSON would have it."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return value[0]
    if hasattr(value, "tolist"):
        return value.tolist()
    return list(map(plain, value)) if isinstance(value, (list, tuple)) or hasattr(value, "append") else value


def differences(kind, seed, count):
    """What the two do not agree on."""
    message_class, text, type_hash = ros2_types.installed(kind)
    ros_type = RosType("/t", kind, type_hash, text)
    if ros_type.decoder is None:
        yield ros_type.error
        return
    definition = ros2_types.parse(kind, text)
    fast = "fastrtps" in rclpy.get_rmw_implementation_identifier()
    values, chance, raws = Values(seed, {}), random.Random(seed), []
    for _ in range(count):
        message = values.fill(message_class())
        if definition.stamped():
            message.header.frame_id = chance.choice(WORDS)
            message.header.stamp.sec, message.header.stamp.nanosec = chance.randrange(-9, 9), 10**9 - 1
        raw = serialize_message(message)
        raws.append(raw)
        value = plain(message)
        # NaN equals itself by its text alone.
        expected = repr(dict(list(view_of(definition, value))[:512]))
        if repr(ros_type.decoder.decode(raw)) != expected:
            yield f"decoded to {ros_type.decoder.decode(raw)!r}, not {expected}"
        if repr(json_message.decode(definition, raw)) != repr(value):
            yield f"read as {json_message.decode(definition, raw)!r}, not {value!r}"
        written = json_message.Writer(definition).write(value)
        if repr(plain(deserialize_message(written, message_class))) != repr(value):
            yield f"the middleware reads {written.hex()} as another message than {raw.hex()}"
        # Fast DDS leaves gaps as they were, and reserves too much.
        if not fast and (not raw.startswith(written) or len(raw) - len(written) > 3):
            yield f"written as {written.hex()}, not {raw.hex()}"
        if definition.stamped() and stamp_ns(raw, ros2=True) != (message.header.stamp.sec + 1) * 10**9 - 1:
            yield f"the stamp is {stamp_ns(raw, ros2=True)}"
    batch = Batch("0badcafe", 0, list(range(count)), {}, 0, Messages(ros_type.id, ros_type.layout, raws))
    again = messages_of(encode_batch(batch), {ros_type.id: ros_type.layout})[1]
    if list(again.raw) != raws:
        yield "its batch gives other messages"


def main():
    packages = get_message_interfaces(list(get_interface_packages()))
    kinds = [f"{package}/{name}" for package, names in sorted(packages.items()) for name in sorted(names)]
    for i, kind in enumerate(kinds):
        for difference in differences(kind, int(sys.argv[1]) + i, int(sys.argv[2])):
            print(f"{kind}: {difference}", flush=True)
    print("compared", *kinds, flush=True)


if __name__ == "__main__":
    main()
