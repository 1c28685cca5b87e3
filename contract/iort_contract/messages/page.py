"""The messages to the live page: its configuration, and its server's answers.

Each is sent as JSON. `make docs-parts` writes TypeScript's types into station/web/src/base/contract.ts.
"""

from __future__ import annotations

from typing import Literal, TypedDict, Union

from iort_contract.limits import Value
from iort_contract.messages.insights import (
    AnalysisAnswer,
    AnalysisStarted,
    DeltaAnswer,
    Extent,
    IncidentCounts,
    IncidentPicture,
    IncidentsAnswer,
    InsightsAnswer,
    KeepAnswer,
    LapsAnswer,
    NotesAnswer,
)


class TrackMap(TypedDict):
    """A closed track's centre line and its widths to either side: `iort_contract.track.Track`."""

    x_m: list[float]
    y_m: list[float]
    w_right_m: list[float]
    w_left_m: list[float]


class Identity(TypedDict):
    """The identity that everybody gets, of an Amazon Cognito identity ``pool``, from ``endpoint``.

    Its credentials sign ``socket``, the broker's address, for the service iotdevicegateway. Client ids begin
    with ``client_prefix``. It hears ``robots``, or all of them if there are none; it publishes nothing.
    """

    pool: str
    region: str
    endpoint: str
    socket: str
    client_prefix: str
    robots: list[str]


class Config(TypedDict):
    """``config.json``: where to listen. ``live`` is ``pubnub``, by ``subscribe_key`` at ``origin``; or
    ``iot``, by addresses of the server's answer ``socket``, or of a static site's ``identity``. ``drivers``
    says whether the action ``drive`` gives addresses that may send commands. ``token`` is PubNub's access
    token, or empty. ``answers`` says whether the server answers questions about the past; a static site does
    not. ``actions`` names what the server changes when it is asked; those in ``keyed`` need its key, which is
    a new one at every start: see `Admitted`. ``invite`` is the command, for who serves the page, whose link
    gives one more browser the key; empty if there is none. ``vehicles`` maps a robot to its `Vehicle`'s
    parameters. ``track`` is the track that the cars drive on, if it is known."""

    namespace: str
    live: Literal["pubnub", "iot"]
    identity: Identity | None
    drivers: bool
    subscribe_key: str
    origin: str
    tls: bool
    token: str
    answers: bool
    actions: list[str]
    keyed: list[str]
    invite: str
    vehicles: dict[str, dict[str, float]]
    track: TrackMap | None


class SocketAnswer(TypedDict):
    """Answers ``socket``, for a viewer, and the action ``drive``, for a driver: an address of the
    broker, to be opened within 5 minutes, and the client id for the connection."""

    url: str
    client_id: str


class IceServerEntry(TypedDict):
    """A STUN or TURN server, as a browser takes it; ``username`` and ``credential`` are a TURN server's."""

    urls: list[str]
    username: str
    credential: str


class IceAnswer(TypedDict):
    """Answers ``ice``: the deployment's servers for video by WebRTC, for a session that begins now; none
    without the setting ``turn``. Their credentials end within minutes, so ask before each offer."""

    ice_servers: list[IceServerEntry]


class Admitted(TypedDict):
    """Answers ``key``, once for each token; or again for the key itself."""

    key: str


class ViewAnswer(TypedDict):
    """Answers ``view``: of how many robots a live lane was asked for."""

    asked: int


class RobotPresence(TypedDict):
    """Whether a robot is connected, and since when it is or is not; null if it never was."""

    online: bool
    since_ms: int | None


class RobotsAnswer(TypedDict):
    """Answers ``robots``."""

    robots: dict[str, RobotPresence]


class TagsAnswer(TypedDict):
    """Answers ``tags``: each robot's tags, which are the attributes of its thing."""

    tags: dict[str, dict[str, str]]


class VehiclesAnswer(TypedDict):
    """Answers ``vehicles``: as in `Config`."""

    vehicles: dict[str, dict[str, float]]


class StreamsAnswer(TypedDict):
    """Answers ``streams``: the names of a robot's streams."""

    streams: list[str]


class StreamFields(TypedDict):
    """The fields of a stream with numbers, by its newest samples, and those of its ``position``: x and y in
    metres, or latitude and longitude in ``degrees``; none without a position."""

    numbers: list[str]
    position: list[str]
    degrees: bool


class FieldsAnswer(TypedDict):
    """Answers ``fields``: those of each stream of a robot."""

    streams: dict[str, StreamFields]


class RacelineAnswer(TypedDict):
    """Answers ``raceline``: the closed line of least curvature on the page's track, and the time of a lap of
    the default car; without points for the ``reason`` given."""

    x_m: list[float]
    y_m: list[float]
    lap_s: float
    reason: str


class TriggerEntry(TypedDict):
    """A trigger that a robot's event recorder is to have: its condition, or what else fires it, beside the
    robot's ``answer``: "accepted", why not, or nothing yet. With ``notify`` it tells, and keeps nothing."""

    name: str
    stream: str
    when: str
    cooldown_s: float
    notify: bool
    answer: str


class TriggersAnswer(TypedDict):
    """Answers ``triggers`` and ``remove_trigger``: those of a robot."""

    triggers: list[TriggerEntry]


class DryRunAnswer(TypedDict):
    """Answers ``dry_run``: how often a condition became true in the ``samples`` of a range, and how many
    incidents would have told of it, after cooldown and merge; with the first ``times_s``."""

    edges: int
    told: int
    samples: int
    times_s: list[float]


class RunPart(Extent):
    """What a run recorded of a stream. ``batches`` is how many it numbered. ``samples`` is how many the agent
    counted, up to its last report; null without a report."""

    batches: int
    samples: int | None


RunState = Literal["running", "ended", "cut off", "unknown"]


class Run(Extent):
    """A run of a robot's agent, from its start to its end. ``run`` is its name in batch ids. ``state`` is
    "cut off" if it did not end properly, and "unknown" without a report of the agent, or if it goes on after
    the range. ``lost`` counts the
    messages and samples that the agent reports as not recorded. ``streams`` is empty if nothing was
    recorded."""

    run: str
    state: RunState
    lost: int
    streams: dict[str, RunPart]


class RunsAnswer(TypedDict):
    """Answers ``runs``: the runs of a robot's agent, newest first. ``older`` tells whether there are more;
    ask for those before the last one's ``from_us``. ``streams`` has the extent of all that is stored."""

    runs: list[Run]
    older: bool
    streams: dict[str, Extent]


class DashboardsAnswer(TypedDict):
    """Answers ``dashboards``: their names."""

    dashboards: list[str]


class SettingKind(TypedDict):
    """What values a setting has."""

    kind: Literal["flag", "number", "choice", "fields"]
    low: float
    high: float
    unit: str
    names: list[str]


class SettingEntry(SettingKind):
    """A setting of a running agent. ``low``, ``high`` and ``unit`` are a number's, ``names`` a choice's.
    ``value`` is in force, as text, and empty if the agent has not reported it. ``desired`` tells whether it
    was changed from here, so that car.yaml's value can return. ``pending`` is the value that the agent has
    not taken yet: null if it took the last one, and empty if it shall send all fields. ``reason`` says why it
    rejected the last one."""

    name: str
    value: str
    desired: bool
    pending: str | None
    reason: str


class SettingsAnswer(TypedDict):
    """Answers ``settings`` and ``set``."""

    settings: list[SettingEntry]
    online: bool


class DriveLimitsEntry(TypedDict):
    """What a stick drives, and how far: `iort_contract.messages.commands.DriveLimits`."""

    command: str
    speed: str
    steering: str
    max_speed_mps: float
    max_steering_rad: float
    lease_ms: int


class VideoTermsEntry(TypedDict):
    """What a robot's camera can show: `iort_contract.messages.video.VideoTerms`. It takes no motion by a
    picture that is older than ``max_age_ms``."""

    width: int
    height: int
    rate_hz: float
    max_age_ms: int


class MotionEntry(TypedDict):
    """Whether a robot may move. ``asked`` is the emergency stop as it was last asked for here or elsewhere,
    unless the robot rejected it; ``stopped`` as the robot has confirmed it, null before it does. ``reason``
    says why it rejected a stop or a release. ``stands``: by the robot's own word it takes no motion by
    command until it is released. ``stoppable``: whether a stop ends its motion; false if nothing that moves
    it can be stopped from here, null before it has said so. ``why_not`` is for a human, empty if it is
    stoppable. ``alone``: the release of the fleet does not end this stop. ``by`` is who asked for the stop,
    or else released the robot last, at ``at_ms``; empty if unknown. ``drive`` is null if a stick cannot
    drive it, ``video`` if it has no camera to drive it by."""

    asked: bool
    stopped: bool | None
    reason: str
    stands: bool
    stoppable: bool | None
    why_not: str
    alone: bool
    by: str
    at_ms: int
    drive: DriveLimitsEntry | None
    video: VideoTermsEntry | None


class MotionAnswer(TypedDict):
    """Answers ``motion`` and ``stop``: each robot's. ``user`` is who drives if the viewer gives no name.
    ``failed`` has the reason for each robot whose stop could not be changed."""

    robots: dict[str, MotionEntry]
    user: str
    failed: dict[str, str]


class SendAnswer(TypedDict):
    """Answers ``send``: null if the robot did not answer, with the reason if it is not connected; or its
    reason if it rejected the command."""

    accepted: bool | None
    reason: str
    after_ms: int


class _Mean(TypedDict):
    mean: list[Value]


class Column(_Mean, total=False):
    """A field's values; with minimum and maximum if a row stands for many samples."""

    least: list[Value]
    most: list[Value]


class Archived(Extent):
    """The part of an answer that comes from the archive: the number of its hours, and the first and last of
    their times."""

    hours: int


class HistoryAnswer(TypedDict):
    """Answers ``history``: a stream's samples in a range. ``row_s`` is the time that a row covers; 0
    if each row is a sample. A position is that of the row's last sample. ``ros2`` says whether charge and
    energy have the ROS 2 driver's units.
    ``archive`` is null if all comes from the table. ``refused`` counts what is stored in the range and
    cannot be read; ``reason`` names the first by topic, time and error."""

    times_s: list[float]
    fields: dict[str, Column]
    samples: int
    ros2: bool
    row_s: float
    archive: Archived | None
    refused: int
    reason: str


class Series(TypedDict):
    """A line of a chart; ``right`` for the right axis."""

    label: str
    right: bool
    times_s: list[float]
    values: list[float]


class Alarm(TypedDict):
    """A CloudWatch alarm."""

    name: str
    about: str
    state: Literal["OK", "ALARM", "INSUFFICIENT_DATA"]
    reason: str
    since_s: float


class Acknowledged(TypedDict):
    """Who has seen an alarm, and when."""

    by: str
    at_s: float


class AlarmEntry(Alarm):
    """An alarm with its entry in the catalogue. ``robots`` are the cars that it may be about;
    ``named`` says whether an alert has named them. ``acknowledged`` is null unless it is raised and
    somebody has seen it since."""

    key: str
    meaning: str
    advice: str
    evidence: Literal["quarantine", "logs", "cars"]
    threshold: float | None
    robots: list[str]
    named: bool
    acknowledged: Acknowledged | None


class AlarmsAnswer(TypedDict):
    """Answers ``alarms``, the raised ones first; ``user`` is who acknowledges if the viewer gives no name."""

    alarms: list[AlarmEntry]
    user: str


class Rejected(TypedDict):
    """A message in quarantine; ``robot`` is "-" if it is unknown."""

    id: str
    robot: str
    source: str
    topic: str
    reason: str
    last_s: float
    seen: int


class RejectedAnswer(TypedDict):
    """Answers ``rejected``: the newest messages in quarantine; ``found`` may exceed their number."""

    rejected: list[Rejected]
    found: int


class _Drawn(TypedDict):
    x: int
    y: int
    width: int
    height: int
    title: str
    kind: Literal["series", "number", "alarms", "log", "text", "other"]
    text: str
    period_s: int
    series: list[Series]
    alarms: list[Alarm]


class Widget(_Drawn):
    """A dashboard's widget; ``number`` is its place in the dashboard's body."""

    number: int


class Dashboard(TypedDict):
    """Answers ``dashboard``: a CloudWatch dashboard with its values."""

    name: str
    from_s: int
    to_s: int
    widgets: list[Widget]


class Logs(TypedDict):
    """Answers ``log``: the result of a log widget; ``found`` may exceed the number of rows. The first line of
    a cell says what happened."""

    columns: list[str]
    rows: list[list[str]]
    found: int
    from_s: int
    to_s: int


Answer = Union[
    Admitted,
    ViewAnswer,
    AnalysisAnswer,
    AnalysisStarted,
    InsightsAnswer,
    LapsAnswer,
    DeltaAnswer,
    NotesAnswer,
    IncidentsAnswer,
    IncidentCounts,
    IncidentPicture,
    KeepAnswer,
    RobotsAnswer,
    SocketAnswer,
    IceAnswer,
    TagsAnswer,
    VehiclesAnswer,
    StreamsAnswer,
    FieldsAnswer,
    RacelineAnswer,
    TriggersAnswer,
    DryRunAnswer,
    HistoryAnswer,
    DashboardsAnswer,
    Dashboard,
    Logs,
    AlarmsAnswer,
    RejectedAnswer,
    RunsAnswer,
    MotionAnswer,
    SendAnswer,
    SettingsAnswer,
]
