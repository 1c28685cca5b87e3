"""Prints messages as bytes in base64: `serialized.py TYPE VALUES TYPE VALUES ...`, the values as YAML."""

# ruff: noqa: T201 - standard output goes to the test that started it

import base64
import sys

import yaml
from rclpy.serialization import serialize_message
from rosidl_runtime_py import set_message_fields
from rosidl_runtime_py.utilities import get_message

for kind, values in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
    message = get_message(kind)()
    set_message_fields(message, yaml.safe_load(values))
    print(base64.b64encode(serialize_message(message)).decode(), flush=True)
