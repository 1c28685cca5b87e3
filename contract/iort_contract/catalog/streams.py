"""The streams with known fields. A new field of the agent is an entry here; of the VESC, in `vesc`."""

from __future__ import annotations

from typing import Mapping

from iort_contract.catalog.entries import Field, Stream
from iort_contract.catalog.vesc import VESC
from iort_contract.topics import PING_PATHS

RTT_STREAM, AGENT_STREAM, TYPES_STREAM, ACCOUNT_STREAM = "rtt", "agent", "types", "account"
LOG_STREAM, POSE_STREAM, DRIVE_STREAM = "log", "pose", "drive"
INCIDENT_STREAM, VIDEO_STREAM = "incidents", "video"
# One sample per pong, with null in the other paths' fields.
RTT_FIELDS = {path: f"{path}_ms" for path in PING_PATHS}

CATALOG = {
    stream.name: stream
    for stream in (
        VESC,
        Stream(
            POSE_STREAM,
            "where the car is, in the frame of its track or map",
            (
                Field("x", "m", "position of the rear axle's middle", "motion"),
                Field("y", "m", "position of the rear axle's middle", "motion"),
                Field("heading", "rad", "direction of travel: 0 along x, pi/2 along y, -pi to pi", "motion"),
            ),
        ),
        Stream(
            LOG_STREAM,
            "the agent's own warnings and errors; recorded and live",
            (
                Field("level", "", "`warning`, `error` or `critical`"),
                Field("logger", "", "the part of the agent, such as `iort_agent.mqtt.aws`"),
                Field("text", "", "the line, with the exception's if it has one; at most 1,000 characters"),
                Field("left_out", "lines", "lines that were too many to send, since the line before"),
            ),
            own=True,
        ),
        Stream(
            RTT_STREAM,
            "round trips of pings",
            tuple(Field(name, "ms", f"round trip over the path {path}") for path, name in RTT_FIELDS.items()),
            own=True,
        ),
        Stream(
            AGENT_STREAM,
            "the agent's own figures; counts grow from 0 at its start",
            (
                Field("cpu_percent", "%", "share of one core, since the sample before", label="Processor"),
                Field("rss_mb", "MB", "memory in use", label="Memory"),
                Field("samples_per_s", "samples/s", "samples from all sources, since the sample before"),
                Field("backlog_batches", "batches", "batches in the spool"),
                Field("backlog_bytes", "bytes", "bytes in the spool"),
                Field("dropped_batches", "batches", "batches dropped because the spool was full"),
                Field("connects", "connections", "connections made"),
                Field("clock_offset_ms", "ms", "cloud's clock minus the car's; null before the first pong"),
                Field("clock_uncertainty_ms", "ms", "uncertainty of the clock offset, either way"),
                Field("files_waiting", "files", "files waiting to be uploaded"),
                Field("files_sent_bytes", "bytes", "bytes of files sent", label="Files sent"),
                Field("thread_errors", "errors", "errors of the agent's threads, since the sample before"),
            ),
            own=True,
        ),
        Stream(
            DRIVE_STREAM,
            "who drove the robot, and when: its motion commands; recorded and live",
            (
                Field("session", "", "the operator's session that sent the command"),
                Field("by", "", "who sent it, as they say; null if they do not"),
                Field("seq", "", "the command's number in its session", label="Command"),
                Field("sent_us", "us", "when it was sent, by the cloud's clock", label="Sent at"),
                Field(
                    "outcome",
                    "",
                    "`accepted`, or why it was refused; `stopped` when the robot was stopped after it",
                ),
                Field("driver", "", "the session that drives now; null if none does"),
                Field("driver_by", "", "who drives now"),
                Field("lease_left_ms", "ms", "how long the driver's lease still holds", label="Lease left"),
                Field(
                    "speed",
                    "m/s",
                    "the speed that the robot was told; null if refused",
                    "motion",
                    label="Speed asked for",
                ),
                Field(
                    "steering",
                    "rad",
                    "the steering angle that it was told",
                    "motion",
                    label="Steering asked for",
                ),
                Field(
                    "frame", "", "the newest picture on the driver's screen; null if the command names none"
                ),
                Field(
                    "frame_age_ms",
                    "ms",
                    "age of that picture when the command came; null if the robot does not know the picture",
                    label="Picture's age",
                ),
                Field("blind", "", "whether the driver said that he drives without a picture"),
            ),
            own=True,
        ),
        Stream(
            VIDEO_STREAM,
            "the pictures that were shown to somebody, at their capture times; recorded",
            (
                Field("frame", "", "the picture's number in this run of the agent", label="Picture"),
                Field("bytes", "bytes", "size of the encoded picture; the JPEG's if nobody had WebRTC"),
                Field("key", "", "whether the picture needs no other one"),
                Field("encode_ms", "ms", "from the capture to the encoded picture", label="Encoding"),
                Field("bitrate_kbps", "kbit/s", "the bitrate that the encoder aimed at", label="Bitrate"),
                Field("viewers", "viewers", "viewers by WebRTC"),
                Field("watchers", "viewers", "viewers of pictures over the broker"),
            ),
            own=True,
        ),
        Stream(
            INCIDENT_STREAM,
            "what the event recorder has kept; a sample at each change, and the newest of an id holds",
            (
                Field("id", "", "the incident, in hexadecimal"),
                Field("trigger", "", "the triggers that fired, with commas; `take` for an operator's"),
                Field("condition", "", "the condition of the first of them"),
                Field("why", "", "the values at the edge, the operator's reason, or why nothing is kept"),
                Field("from_us", "us", "the begin of the window", label="From"),
                Field("to_us", "us", "the end of the window", label="To"),
                Field(
                    "state",
                    "",
                    "`kept` on the robot, `uploaded`, `notified` (only told), `over_budget`, or `lost`",
                ),
                Field("key", "", "the file in the bucket; empty before it is there", label="File"),
                Field("bytes", "bytes", "the size of the file", label="Size"),
                Field("messages", "messages", "messages in the file"),
                Field("missing", "messages", "messages of the window that are known not to be in the file"),
                Field("by", "", "the operator who took it, as they say"),
            ),
            own=True,
        ),
        Stream(TYPES_STREAM, "the ROS types of the streams' messages: `MessageType`", own=True),
        Stream(ACCOUNT_STREAM, "samples taken, stored and not recorded: messages/account.py", own=True),
    )
}
# The streams that every robot may have without configuration.
OWN_STREAMS = frozenset(stream.name for stream in CATALOG.values() if stream.own)
AGENT_FIELDS = {field.name: field for field in CATALOG[AGENT_STREAM].fields}


_VECTOR = dict.fromkeys("xyz", "m")
_SCAN = {
    **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "rad"),
    **dict.fromkeys(("time_increment", "scan_time"), "s"),
    **dict.fromkeys(("range_min", "range_max", "ranges"), "m"),
}
_TIME = {"sec": "s", "nanosec": "ns"}
_PLACE = {"latitude": "deg", "longitude": "deg", "altitude": "m"}
_CHARGE = dict.fromkeys(("charge", "capacity", "design_capacity"), "Ah")
# Type -> field -> unit of the field, or of the numbers within it. Sources: the comments of the types'
# definitions, and REP 103.
TYPE_UNITS: Mapping[str, Mapping[str, str]] = {
    "ackermann_msgs/AckermannDrive": {
        "steering_angle": "rad",
        "steering_angle_velocity": "rad/s",
        "speed": "m/s",
        "acceleration": "m/s^2",
        "jerk": "m/s^3",
    },
    "duration": _TIME,
    "geographic_msgs/GeoPoint": _PLACE,
    "geometry_msgs/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/Point": _VECTOR,
    "geometry_msgs/Point32": _VECTOR,
    "geometry_msgs/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "geometry_msgs/Transform": {"translation": "m"},
    "geometry_msgs/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/Wrench": {"force": "N", "torque": "N m"},
    "sensor_msgs/BatteryState": {
        "voltage": "V",
        "cell_voltage": "V",
        "temperature": "degC",
        "cell_temperature": "degC",
        "current": "A",
        **_CHARGE,
        "percentage": "1",
    },
    "sensor_msgs/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/Illuminance": {"illuminance": "lx"},
    "sensor_msgs/Imu": {"linear_acceleration": "m/s^2", "angular_velocity": "rad/s"},
    "sensor_msgs/LaserScan": _SCAN,
    "sensor_msgs/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/MultiEchoLaserScan": _SCAN,
    "sensor_msgs/NavSatFix": {**_PLACE, "position_covariance": "m^2"},
    "sensor_msgs/Range": {"field_of_view": "rad", "min_range": "m", "max_range": "m", "range": "m"},
    "sensor_msgs/RelativeHumidity": {"relative_humidity": "1"},
    "sensor_msgs/Temperature": {"temperature": "degC"},
    "time": _TIME,
}
# Field -> unit of the fields x, y and z within it, for samples without a known type.
ROS_UNITS = {
    "linear_acceleration": "m/s^2",
    "angular_velocity": "rad/s",
    "twist.linear": "m/s",
    "twist.angular": "rad/s",
    "position": "m",
    "translation": "m",
}
