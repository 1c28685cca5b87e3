"""How large, old and many things may be, and what every refusal is."""

from __future__ import annotations

from typing import Union

SCHEMA_VERSION = 1
# Of the record lane: batches of version 1 had no id.
BATCH_VERSION = 2
DEFAULT_NAMESPACE = "iort"

# AWS IoT Core closes a connection that publishes more than 128 KB ("Message size", service quotas),
# and an MQTT 5 client counts topic and header in: a kilobyte is left to them.
MAX_MESSAGE_BYTES = 127 * 1024
# PubNub refuses a message above 32 KiB, measured after URL encoding.
MAX_PUBNUB_BYTES = 32 * 1024
# A live message older than this when Lambda 1 sees it is dropped: the dashboard shows now.
LIVE_MAX_AGE_MS = 2_000
# A car says by how much its clock and the cloud's differ only where it knows that well enough to judge
# by: wrong by a quarter of the age above at most.
CLOCK_MAX_UNCERTAINTY_MS = 500
# The slowest is seen by alarms that look at five minutes.
LIVE_MIN_RATE_HZ, LIVE_MAX_RATE_HZ = 0.01, 10.0
# Most live messages go straight to their rule, which costs no messaging; one as often as this, at least,
# passes the broker, where other rules and subscribers see it.
LIVE_BROKER_EVERY_S = 10.0

# Bounds that keep a hostile or broken message from costing more than a good one.
MAX_SAMPLES = 50_000
# A clock that is off by more than this has no date at all: of a dead battery, or of an overflow. Lambda 2
# then refuses the batch; a car that believes in 1970 is let through, replayed drives are as old.
MAX_AHEAD_US = 366 * 86_400 * 1_000_000
# A batch closes after a second, so a range read starts one second early and misses nothing.
MAX_BATCH_SPAN_US = 1_000_000
MAX_FIELDS = 512
# Of a batch, samples times fields: what a car of 1000 Hz and 50 fields says in a second. The agent closes a
# batch at 20,000 and halves one that holds more than this. Reading as many takes some 20 ms.
MAX_BATCH_VALUES = 50_000
# Nested messages make long paths; a name is not the place for megabytes.
MAX_FIELD_CHARACTERS = 1024
MAX_COLUMNS_BYTES = 8 * 1024 * 1024
# Of a batch of serialized messages; one message alone may be as large as a batch's columns.
MAX_SERIALIZED_BYTES = 2 * 1024 * 1024

Value = Union[None, bool, int, float, str]


class ContractError(ValueError):
    """A name, topic, message or item that the contract does not allow; the text says which."""


class MessageError(ContractError):
    """A ROS message does not fit its definition, or the definition is none."""
