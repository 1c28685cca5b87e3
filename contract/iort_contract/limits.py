"""Limits of size, age and number, and the errors for exceeding them."""

from __future__ import annotations

from typing import Union

SCHEMA_VERSION = 1
# Schema version of the record lane.
BATCH_VERSION = 2
DEFAULT_NAMESPACE = "iort"

# AWS IoT Core closes a connection that publishes more than 128 KB ("Message size", service quotas). An MQTT 5
# client counts topic and header too, so a kilobyte is left for them.
MAX_MESSAGE_BYTES = 127 * 1024
# PubNub refuses a message above 32 KiB, measured after URL encoding.
MAX_PUBNUB_BYTES = 32 * 1024
# The page and `iort watch` show an older value as stale, and a robot unheard of for longer as gone.
STALE_S, GONE_S = 1.5, 4.5
# Lambda 1 drops a live message older than this: the dashboard shows the present.
LIVE_MAX_AGE_MS = 2_000
# A car sends its clock offset only if it is accurate enough for this check: within a quarter of the age
# above.
CLOCK_MAX_UNCERTAINTY_MS = 500
# The slowest live lane. Alarms look at five minutes, and still see it.
LIVE_MIN_RATE_HZ, LIVE_MAX_RATE_HZ = 0.01, 10.0
# The longest time between two live messages of a stream: that of the slowest rate.
MAX_NEXT_MS = 100_000
# Most live messages go straight to their rule, which costs no messaging. One per this time, at least, passes
# the broker, where other rules and subscribers see it.
LIVE_BROKER_EVERY_S = 10.0

# These limits keep a hostile or broken message from costing more than a good one.
MAX_SAMPLES = 50_000
# A clock further ahead than this has no valid date, for example after a dead battery or an overflow; Lambda 2
# then refuses the batch. A car that believes in 1970 is accepted, since replayed drives are as old.
MAX_AHEAD_US = 366 * 86_400 * 1_000_000
# A batch closes after a second, so a range query starts one second early and misses nothing.
MAX_BATCH_SPAN_US = 1_000_000
MAX_FIELDS = 512
# Levels of JSON: far more than any ROS message has, far fewer than fill a stack.
MAX_NESTED = 200
# Samples times fields of a batch: a second of a car with 1000 Hz and 50 fields. The agent closes a batch at
# 20,000 and splits a larger one. Decoding this many takes some 20 ms.
MAX_BATCH_VALUES = 50_000
# Nested messages make long paths; longer names are refused.
MAX_FIELD_CHARACTERS = 1024
MAX_COLUMNS_BYTES = 8 * 1024 * 1024
# The size of a batch of serialized messages; a single message may be as large as a batch's columns.
MAX_SERIALIZED_BYTES = 2 * 1024 * 1024

Value = Union[None, bool, int, float, str]


class ContractError(ValueError):
    """A name, topic, message or item that violates the contract; the text says which."""


class MessageError(ContractError):
    """A ROS message that does not fit its definition, or an invalid definition."""
