"""The attributes of the tables' items: telemetry, summary, quarantine, registry."""

from __future__ import annotations

# Attributes that the cloud adds in the telemetry and summary tables.
TOPIC, BATCH, SECOND = "topic", "batch", "second"
# A time in a message, microseconds since the epoch.
T_US = "t"
RECEIVED_MS, EXPIRES_S = "received_ms", "expires_s"
# In an item whose expiry the archive has put off: until when. A batch that is sent again has none.
PUT_OFF_TO_S = "put_off_to_s"
# The lifetime of telemetry and summaries, unless a deployment sets its own.
DEFAULT_RETENTION_DAYS = 90
ROBOT = "robot"
# Registry: the day (UTC) and the bytes of a robot's upload quota.
FILES_DAY, FILES_BYTES = "files_day", "files_bytes"
# Registry: the day (UTC) and the bytes that a robot has recorded on it.
RECORD_DAY, RECORD_BYTES = "record_day", "record_bytes"
DAYS = (FILES_DAY, FILES_BYTES, RECORD_DAY, RECORD_BYTES)
# Registry: the hour (UTC) and the number of a robot's questions, two attributes for each with this prefix.
ASKED_PREFIX = "asked_"
# Registry: the time of the last mail, one attribute per cause with this prefix.
ALERT_PREFIX = "alert_"
# The fault's code follows, or "unknown".
ALERT_FAULT, ALERT_LOW_VOLTAGE = f"{ALERT_PREFIX}fault_", f"{ALERT_PREFIX}low_voltage"
# Registry: what was told of a robot's incidents last, and the hour (UTC) and the number of its mails.
INCIDENT_PREFIX = "incident_"
INCIDENTS_TOLD, INCIDENT_HOUR = f"{INCIDENT_PREFIX}told", f"{INCIDENT_PREFIX}hour"
INCIDENT_MAILS = f"{INCIDENT_PREFIX}mails"
# An event for the function incident: a sample of the stream `incidents`, beside its time and its topic.
INCIDENT = "incident"
STATS = ("min", "mean", "max", "last")
# A second in the summary: samples, their batches, batches missing before those, gaps between samples, values
# that were not finite.
SAMPLES, BATCHES, MISSING_BATCHES = "n", "batches", "missing_batches"
GAPS, NONFINITE = "gaps", "nonfinite"
# In the first batches of a run: the runs before it, and the last number of each.
PREVIOUS = "previous"
# The keys of a batch's envelope; the record rule stores these and no others.
ENVELOPE = ("v", BATCH, SAMPLES, NONFINITE, PREVIOUS, "codec", "samples")
# The fields of a ping; the answer repeats them.
PING_FIELDS = ("v", "id", "sent_us", "padding")
# A rule's message to a function: one opaque value, so that no key of it can replace one of the cloud's.
MESSAGE_BASE64 = "message_base64"
# Only if not zero: values of sensors that are not fitted (contract/iort_contract/catalog/vesc.py).
ABSENT = "absent"
# In a second over DynamoDB's 400 KB: the number of attributes left out, the largest first.
OMITTED = "omitted"

# The quarantine table: every refused message, by robot (`NO_ROBOT` if unknown) and an id made from its
# content, so that a repeated message is one entry.
ENTRY, SOURCE, REASON, PAYLOAD = "id", "source", "reason", "payload"
FIRST_MS, LAST_MS, SEEN, REPLAYS = "first_ms", "last_ms", "seen", "replays"
NO_ROBOT = "-"
# The source of a refusal: a rule's action, Lambda 2 or its stream, another function, or the later function.
BY_RULE, BY_STREAM, BY_FUNCTION, BY_LATER = "rule", "stream", "function", "later"
# In an event for Lambda 2: a replay, whose bad records are returned instead of quarantined again.
REPLAY = "replay"
# Or the first second to summarise again; the answer lists the written seconds as `RECOMPUTED`.
RECOMPUTE_FROM_S, RECOMPUTED = "recompute_from_s", "recomputed"
# In a robot's shadow, desired, after batches had to wait for their summary: first time, last time, count. The
# queue of their keys uses the last name too.
OVER_SHARE = "over_share"
PUT_OFF_SINCE_MS, PUT_OFF_LAST_MS, PUT_OFF = "since_ms", "last_ms", "batches"
# In a queue message of Lambda 2: the stored item as DynamoDB JSON, in base64.
ITEM_BASE64 = "base64Item"

# Lambda 2 reads a robot's row of the registry again after this time at the latest.
VEHICLE_CACHE_S = 60.0
# Registry: the streams that Lambda 2 has seen of a robot.
STREAMS = "streams"
# Registry: when somebody gave the robot's gain. Without it the default is a guess, with which the page shows
# speeds, and on which the analysis does not rest.
GAIN_SET_MS = "speed_to_erpm_gain_set_ms"
# Registry, beside the vehicle parameters: a robot's connection, from the broker's lifecycle events. Times are
# the broker's; the certificate is the one that the robot connected with.
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
# Its provisioning: the machine that owns the name, until when and for which claim a certificate may be
# issued, and the last issued certificate.
SERIAL, ADMIT_UNTIL_S, ADMIT_CLAIM = "serial", "admit_until_s", "admit_claim"
# The SHA-256 of the claim's certificate, in hex: AWS' certificate id, computed by us.
ADMIT_FINGERPRINT = "admit_fingerprint"
ADMITTED_CERTIFICATE, ADMITTED_MS = "admitted_certificate", "admitted_ms"
ADMISSION = (SERIAL, ADMIT_UNTIL_S, ADMIT_CLAIM, ADMIT_FINGERPRINT, ADMITTED_CERTIFICATE, ADMITTED_MS)
# Registry: the deployment from which `iort move` brought the robot.
MOVED_FROM = "moved_from"
# The provisioning template's parameters.
ROBOT_PARAMETER, SERIAL_PARAMETER = "Robot", "Serial"

# The table of findings: by robot and a text that begins with the time of the drive. Beside the findings it
# has a row of each analysed drive, for comparing with later ones, and the operators' notes. A note that was
# deleted leaves a row without its text, so that no copy of it comes back. The keys of each have a prefix.
FINDING, CONTENT = "finding", "content"
PARAMETERS_PREFIX, NOTE_PREFIX, REMOVED_PREFIX = "parameters#", "note#", "removed#"
