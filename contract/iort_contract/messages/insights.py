"""The messages to the live page about what happened: findings, drives and laps of the analysis, people's
notes, and incidents of the event recorder.

They are sent as in `page`."""

from __future__ import annotations

from typing import Literal, TypedDict


class Extent(TypedDict):
    """From the first sample to the time just after the last one, in microseconds since the epoch."""

    from_us: int
    to_us: int


class EstimateEntry(TypedDict):
    """A value with its interval, which holds the truth in nine of ten cases."""

    value: float
    low: float
    high: float
    unit: str


class ParameterEntry(TypedDict):
    """A parameter of the catalogue."""

    unit: str
    meaning: str
    worse: Literal["up", "down", "either"]


class FindingEntry(Extent):
    """A finding of the analysis, with its kind's entry in the catalogue.

    ``start_us`` is the drive's start, the extent that of the evidence. ``effect`` is the change from
    ``baseline``, or the size of an event. ``q`` is the false discovery rate; null if no test was made."""

    id: str
    robot: str
    start_us: int
    kind: str
    severity: Literal["info", "warning", "serious"]
    meaning: str
    action: str
    subject: str
    stream: str
    fields: list[str]
    text: str
    effect: EstimateEntry | None
    baseline: EstimateEntry | None
    q: float | None


class DriveEntry(Extent):
    """An analysed drive. ``failed`` is the reason if it could not be analysed, ``missing`` that of each
    parameter that could not be computed, ``repairs`` counts what was cleaned."""

    robot: str
    samples: int
    failed: str
    repairs: dict[str, int]
    estimates: dict[str, EstimateEntry]
    missing: dict[str, str]


class InsightsAnswer(TypedDict):
    """Answers ``insights``: the findings and the drives of a robot or of the fleet, the newest first.
    ``groups`` has the parameters in the order in which a person reads them."""

    findings: list[FindingEntry]
    drives: list[DriveEntry]
    groups: dict[str, dict[str, ParameterEntry]]


class NoteEntry(TypedDict):
    """What ``by`` wrote about a robot at a time."""

    id: str
    robot: str
    t_us: int
    text: str
    by: str


class NotesAnswer(TypedDict):
    """Answers ``notes``, ``note`` and ``delete_note``: notes about a robot or the fleet, the newest first."""

    notes: list[NoteEntry]


class IncidentEntry(Extent):
    """What a robot's recorder has kept of a time: `iort_contract.messages.recorder.Incident` in its newest
    state. Its file can be downloaded once ``state`` is "uploaded"."""

    id: str
    robot: str
    trigger: str
    state: str
    condition: str
    why: str
    by: str
    bytes: int
    messages: int
    missing: int


class IncidentsAnswer(TypedDict):
    """Answers ``incidents``: those of a robot, the newest first; ``found`` may exceed their number."""

    incidents: list[IncidentEntry]
    found: int


class IncidentPicture(TypedDict):
    """Answers ``incident_picture``: what its file shows. ``jpeg``, in base64, is the image of ``topic``
    nearest to the edge, ``after_s`` later. Without an image they are empty, and ``field`` has ``values``
    at ``times_s`` after the edge; without those, it is empty too."""

    jpeg: str
    topic: str
    after_s: float
    field: str
    times_s: list[float]
    values: list[float]


class IncidentCounts(TypedDict):
    """Answers ``incident_counts``: how many incidents of the last day each robot has, if it has any."""

    counts: dict[str, int]


class KeepAnswer(TypedDict):
    """Answers ``keep`` and ``add_trigger``: the robot's answer; null if it did not give one. ``reason`` says
    why it refused."""

    accepted: bool | None
    reason: str
    online: bool


class AnalysisStarted(TypedDict):
    """Answers ``analyse``: the run of the analysis."""

    run: str


class AnalysisAnswer(TypedDict):
    """Answers ``analysis``: how far a run is. ``drives`` is null until they are found."""

    running: bool
    drives: int | None
    done: int


class Lap(Extent):
    """A lap; null for what is not known. ``complete`` is false if it does not fit the others."""

    lap: int
    time_s: float
    distance_m: float | None
    energy_wh: float | None
    energy_wh_per_km: float | None
    mean_speed_mps: float | None
    top_speed_mps: float | None
    complete: bool
    best: bool


class LapsAnswer(TypedDict):
    """Answers ``laps``: those of a robot in a range. ``method`` is "gate" or "pattern", and empty without
    laps, for the ``reason`` given. ``estimates`` has the best and the mean."""

    laps: list[Lap]
    method: str
    confidence: float
    reason: str
    estimates: dict[str, EstimateEntry]


class DeltaAnswer(TypedDict):
    """Answers ``delta``: how far lap ``other`` is behind lap ``one`` at each place, and their speeds. Places
    are in metres; in shares of the lap if its length is not known, and then the speeds are null."""

    places: list[float]
    unit: Literal["m", "%"]
    delta_s: list[float]
    one_mps: list[float | None]
    other_mps: list[float | None]
