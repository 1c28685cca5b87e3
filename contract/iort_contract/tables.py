"""The attributes of the tables' items, which the messages share: telemetry, summary, quarantine, registry."""

from __future__ import annotations

# Attributes of the telemetry and summary tables that are not the robot's own.
TOPIC, BATCH, SECOND = "topic", "batch", "second"
# A time in a message, microseconds since the epoch.
T_US = "t"
RECEIVED_MS, EXPIRES_S = "received_ms", "expires_s"
ROBOT = "robot"
# Of a robot in the registry: on which day (UTC) it has asked to upload how many bytes.
FILES_DAY, FILES_BYTES = "files_day", "files_bytes"
# And when a human was last told of what: a name for each cause, after this.
ALERT_PREFIX = "alert_"
STATS = ("min", "mean", "max", "last")
# Of a second in the summary: samples, batches they came in, batches missing before those, holes
# between samples, values that were not finite.
SAMPLES, BATCHES, MISSING_BATCHES = "n", "batches", "missing_batches"
GAPS, NONFINITE = "gaps", "nonfinite"
# The keys of a batch's envelope: all that the record rule stores of a message.
ENVELOPE = ("v", BATCH, SAMPLES, NONFINITE, "codec", "samples")
# And, only where there are some, values of sensors that are not fitted (contract/iort_contract/vesc.py).
ABSENT = "absent"
# Of a second that would be larger than DynamoDB's 400 KB: attributes left out, the largest first.
OMITTED = "omitted"

# The quarantine table: every message that was refused or could not be processed, by robot (`NO_ROBOT`
# where nobody can tell) and an id that follows from its content, so that the same one again is no other.
ENTRY, SOURCE, REASON, PAYLOAD = "id", "source", "reason", "payload"
FIRST_MS, LAST_MS, SEEN, REPLAYS = "first_ms", "last_ms", "seen", "replays"
NO_ROBOT = "-"
# Where it was refused: by a rule's action, by Lambda 2 or on the way to it, by another function; or what
# Lambda 2 put off could not be summarised later.
BY_RULE, BY_STREAM, BY_FUNCTION, BY_LATER = "rule", "stream", "function", "later"
# In an event for Lambda 2: a replay, whose records are answered for and not put into quarantine again.
REPLAY = "replay"
# Or the second from which stored batches are summarised again, whose answer says as `RECOMPUTED` which were.
RECOMPUTE_FROM_S, RECOMPUTED = "recompute_from_s", "recomputed"
# What a robot's shadow says, as desired, once batches of it had to wait for their summary: since when, when
# last, how many; the last is also what the queue of their keys has them under.
OVER_SHARE = "over_share"
PUT_OFF_SINCE_MS, PUT_OFF_LAST_MS, PUT_OFF = "since_ms", "last_ms", "batches"
# What a queue's message of Lambda 2's carries: the stored item as DynamoDB JSON, in base64.
ITEM_BASE64 = "base64Item"

# Lambda 2 reads a robot's row of the registry again after this time at the latest.
VEHICLE_CACHE_S = 60.0
# Of a robot in the registry: the streams that Lambda 2 has seen of it.
STREAMS = "streams"
# The registry's row of a robot, beside its vehicle parameters. Of its connection, by the broker's
# lifecycle events: times are the broker's, and the certificate is the one that it connected with.
ONLINE, LAST_SEEN_MS = "online", "last_seen_ms"
CONNECTED_MS, DISCONNECTED_MS = "connected_ms", "disconnected_ms"
DISCONNECT_REASON, CERTIFICATE_ID, AGENT_VERSION = "disconnect_reason", "certificate_id", "agent_version"
# Grows by connection, and orders the events, which may overtake each other.
SESSION_VERSION = "session_version"
PRESENCE = (
    ONLINE,
    CONNECTED_MS,
    DISCONNECTED_MS,
    LAST_SEEN_MS,
    DISCONNECT_REASON,
    CERTIFICATE_ID,
    AGENT_VERSION,
    SESSION_VERSION,
)
# Of its provisioning: the machine that has the name, until when a certificate may be issued for it and
# for which claim alone, and the certificate that was issued last.
SERIAL, ADMIT_UNTIL_S, ADMIT_CLAIM = "serial", "admit_until_s", "admit_claim"
# The SHA-256 of the claim's certificate, in hex: what AWS calls a certificate, computed by us.
ADMIT_FINGERPRINT = "admit_fingerprint"
ADMITTED_CERTIFICATE, ADMITTED_MS = "admitted_certificate", "admitted_ms"
ADMISSION = (SERIAL, ADMIT_UNTIL_S, ADMIT_CLAIM, ADMIT_FINGERPRINT, ADMITTED_CERTIFICATE, ADMITTED_MS)
# The provisioning template's parameters.
ROBOT_PARAMETER, SERIAL_PARAMETER = "Robot", "Serial"
