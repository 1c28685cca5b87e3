"""A lab whose page has something on every view: its addresses, and its server's answers."""

from __future__ import annotations

import functools
import math
import threading
import time
from typing import NamedTuple

from iort_contract.catalog.analysis import GROUPS, KINDS, PARAMETERS
from iort_contract.catalog.metrics import METRICS, alarm_of
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.commands import NO_MOTION
from iort_station.errors import StationError
from iort_station.page import insights as analysis
from testkit.waiting import GUARD_S
from tests.unit.station.data.test_queries import START
from tests.unit.station.data.test_runs import driven_cloud
from tests.web.cars import GAIN, SAMPLE

_DAY_US = 86_400_000_000
# The drive of laps that the newest drive is.
END = START + 90_000_000
_driven = functools.cache(driven_cloud)


def _estimate(value, either, unit):
    return {"value": value, "low": value - either, "high": value + either, "unit": unit}


def drive(days_ago, *, failed="", robot="car-1"):
    start_us = START - days_ago * _DAY_US
    grown = 0.04 + 0.003 * max(0, 5 - days_ago)
    estimates = {
        "battery_resistance_ohm": _estimate(grown, 0.002, "ohm"),
        "lap_best_s": _estimate(11.3 + 0.1 * math.sin(days_ago), 0.01, "s"),
        "lap_mean_s": _estimate(12 + 0.1 * math.sin(days_ago), 0.2, "s"),
    }
    missing = {"lap_energy_wh": "needs voltage and current of the battery"}
    known = {} if failed else {"estimates": estimates, "missing": missing}
    times = {"from_us": start_us, "to_us": start_us + END - START}
    more = {"samples": 4500, "failed": failed, "repairs": {"outlier": 12, "gap": 1}}
    return {"robot": robot, **times, **more, "estimates": {}, "missing": {}, **known}


def finding(kind, **given):
    entry = KINDS[kind]
    return {
        "id": kind,
        "robot": "car-1",
        "start_us": START,
        "from_us": START + 60_000_000,
        "to_us": START + 90_000_000,
        "kind": kind,
        "severity": entry.severity,
        "meaning": entry.meaning,
        "action": entry.action,
        "subject": "battery_resistance_ohm",
        "stream": VESC_STREAM,
        "fields": ["voltage_input", "current_input"],
        "text": "the internal resistance is 55 mΩ, half again of what it was",
        "effect": _estimate(0.015, 0.003, "ohm"),
        "baseline": _estimate(0.04, 0.003, "ohm"),
        "q": 0.002,
        **given,
    }


def insights(asked):
    robot = asked.get("robot", "car-1")
    groups = {
        group: {p.name: {"unit": p.unit, "meaning": p.meaning, "worse": p.worse} for p in parameters}
        for group, parameters in GROUPS.items()
    }
    findings = [
        finding("battery_worn", robot=robot),
        finding("battery_worn", robot=robot, severity="serious", baseline=None, q=None, id="other"),
    ]
    drives = [drive(i, robot=robot) for i in range(6)]
    failed = drive(6, failed="the Lambda function ran out of memory", robot=robot)
    assert set(drives[0]["estimates"]) < PARAMETERS.keys()
    return {"findings": findings, "drives": [*drives, failed], "groups": groups}


def of_laps(answer):
    """The server's own answer of the drive's laps."""
    return lambda asked: answer(_driven(), {**asked, "robot": "car"})


class View(NamedTuple):
    """A view's address, and something that it shows once it has its data."""

    address: str
    filled: str


# Every view of the page. A new view belongs here: tests then look at it.
VIEWS = {
    "fleet": View("#/", "[data-robot=car-1]"),
    "car": View("#/car/car-1", ".gauge"),
    "history": View("#/history/car-1", ".history .charts canvas"),
    "panels of the past": View(
        "#/history/car-1?fields=map:pose:speed,speed~pose/x,xy:speed:pose/y,table:vesc,voltage_input",
        ".rows tbody tr",
    ),
    "compare": View(
        "#/compare?runs=car-1/2026-05-04T10:00:00.000Z/2026-05-04T10:01:00.000Z,"
        "car-1/2026-05-04T11:00:00.000Z/2026-05-04T11:01:00.000Z",
        ".compare-view .charts canvas",
    ),
    "insights": View("#/insights/car-1", ".insights-view .charts canvas"),
    "insights of the fleet": View("#/insights", ".insights-view .drives tbody tr"),
    "alarms": View("#/alarms", "[data-alarm=Quarantined] .cases li"),
    "cloudwatch": View("#/cloudwatch", ".log summary"),
}
TRACEBACK = """[ERROR] ValueError: the gain of car-7 must not be 0
  File "/var/task/functions/live.py", line 61, in handler
    publish(event)"""
LOG = {
    "columns": ["@timestamp", "@log", "@message"],
    "rows": [["2026-05-04 10:00:00.123", "123456789012:/aws/lambda/live", TRACEBACK]],
}
NOW_S = time.time()
REJECTED = {
    "id": "0a1b2c",
    "robot": "car-1",
    "source": "stream",
    "topic": "record/iort/car-1/vesc",
    "reason": "column speed must have 10 values, got 9",
    "last_s": NOW_S - 300,
    "seen": 2,
}
WHY_NOT = f"a stop does nothing there: {NO_MOTION}"
_LONG = "a_field_" + "x" * 99


def alarm(key, state="ALARM", **given):
    entry = alarm_of(key)
    assert entry
    return {
        "name": f"iort-{key}",
        "key": key,
        "about": "",
        "state": state,
        "reason": "Threshold crossed",
        "since_s": NOW_S - 600,
        "meaning": entry.meaning,
        "advice": entry.advice,
        "evidence": entry.evidence,
        "threshold": 80.0 if key == "TemperatureDegC" else 10.5,
        "robots": [],
        "named": False,
        "acknowledged": None,
        **given,
    }


_PLAIN = {"low": 0.0, "high": 10.0, "unit": "", "names": [], "desired": False, "pending": None, "reason": ""}
SETTINGS = [
    {**_PLAIN, "name": "live.enabled", "kind": "flag", "value": "true"},
    {**_PLAIN, "name": "live.rate_hz", "kind": "number", "unit": "Hz", "value": "10", "pending": "5"},
    {**_PLAIN, "name": "log_level", "kind": "choice", "names": ["info", "debug"], "value": ""},
    {**_PLAIN, "name": "fields.vesc", "kind": "fields", "value": "speed", "desired": True, "reason": "sped"},
]


def incident(number, state, **given):
    """The incidents of the last minute, the newest is number 1."""
    from_us = round(NOW_S - 10 - 15 * number) * 1_000_000
    return {
        "id": f"{number:016x}",
        "robot": "car-1",
        "from_us": from_us,
        "to_us": from_us + 10_000_000,
        "trigger": "hardbrake",
        "state": state,
        "condition": "current_input < -15 and speed_mps > 2",
        "why": "",
        "by": "",
        "bytes": 0,
        "messages": 0,
        "missing": 0,
        **given,
    }


def trigger(name, when, *, notify=True):
    more = {"cooldown_s": 60.0, "notify": notify, "answer": "accepted"}
    return {"name": name, "stream": VESC_STREAM, "when": when, **more}


NO_PICTURE = {"jpeg": "", "topic": "", "after_s": 0.0, "field": "", "times_s": [], "values": []}
LIMITS = {"command": "drive", "speed": "drive.speed", "steering": "drive.steering_angle"}
LIMITS |= {"max_speed_mps": 2.0, "max_steering_rad": 0.4, "lease_ms": 500}


class Lab:
    """What the lab's server answers; a test may change it."""

    def __init__(self):
        self.asked = []
        self.refuses = False
        # The counts of conditions wait for it.
        self.counts = threading.Event()
        self.counts.set()
        # Whether each car is told to stop, and whether it stands.
        self.cars = {"car-1": [False, False], "car-9": [False, False]}
        self.confirms = True
        self.streams = [VESC_STREAM]
        # What car-1's camera can show, and a broker that gives pages addresses, if there is one.
        self.video = None
        self.broker = None
        # The cars that were stopped alone.
        self.alone = set()
        # The cars without a command that moves them, which reject a stop.
        self.unstoppable = set()
        self.incidents = [
            incident(1, "uploaded", bytes=12_300_000, messages=4_321, missing=3),
            incident(2, "kept", trigger="take", by="operator@lab", why="hit the kerb"),
            incident(3, "over_budget", why="hardbrake has spent its 500 MB of the day"),
        ]
        # What an incident shows, and for which of them that was asked.
        self.pictures = []
        self.shown = {**NO_PICTURE, "field": "current_input"}
        self.shown |= {"times_s": [-2.0, 0.0, 1.0, 2.0], "values": [3.0, -20.0, -21.0, -5.0]}
        self.keeps = {"accepted": True, "reason": "", "online": True}
        self.triggers = [trigger("brake", "current_input < -15", notify=False)]
        self.notes = []
        self.write({"robot": "car-1", "text": "changed the left front tyre"})
        self.alarms = [
            alarm("FaultSamples", robots=["car-1", "car-2"], named=True),
            alarm("Quarantined"),
            alarm("SummarizeErrors", acknowledged={"by": "ada", "at_s": NOW_S - 60}),
            *(alarm(name, "OK") for name, metric in METRICS.items() if metric.alarm and name[0] in "TBP"),
        ]

    def answer_alarms(self, _asked):
        if self.refuses:
            raise StationError("no such right")
        return {"alarms": self.alarms, "user": "operator@lab"}

    def answer_notes(self, asked):
        low, high = (int(asked.get(name, 0)) for name in ("from_us", "to_us"))
        return {"notes": [one for one in self.notes if low <= one["t_us"] < (high or math.inf)]}

    def answer_incidents(self, asked):
        low, high = int(asked["from_us"]), int(asked.get("to_us", 2**53))
        found = [one for one in self.incidents if one["to_us"] >= low and one["from_us"] < high]
        return {"incidents": found, "found": len(found)}

    def picture(self, asked):
        self.pictures.append(asked["id"])
        if self.refuses:
            raise StationError("the file is not in the bucket any more")
        return self.shown

    def keep(self, asked):
        self.asked.append(dict(asked))
        if self.keeps["accepted"]:
            now_us = time.time_ns() // 1000
            taken = incident(9, "kept", trigger="take", from_us=now_us - 60_000_000, to_us=now_us)
            self.incidents = [taken, *self.incidents]
        return self.keeps

    def download(self, asked, folder):
        if self.refuses:
            raise StationError("the file is not in the bucket any more")
        path = folder / f"hardbrake-{asked['id']}.mcap"
        path.write_bytes(b"messages")
        return path

    def dry_run(self, asked):
        self.asked.append(dict(asked))
        assert self.counts.wait(GUARD_S)
        if "sped" in asked["when"]:
            raise StationError("car-1 has no sped in vesc")
        return {"edges": 3, "told": 1, "samples": 3000, "times_s": []}

    def add_trigger(self, asked):
        self.asked.append(dict(asked))
        if self.keeps["accepted"] is not False:
            answer = "accepted" if self.keeps["accepted"] else ""
            self.triggers = [*self.triggers, {**trigger(asked["name"], asked["when"]), "answer": answer}]
        return self.keeps

    def remove_trigger(self, asked):
        self.triggers = [one for one in self.triggers if one["name"] != asked["name"]]
        return {"triggers": self.triggers}

    def acknowledge(self, asked):
        self.asked.append(dict(asked))
        seen = {"by": asked["by"] or "operator@lab", "at_s": time.time()}
        next(entry for entry in self.alarms if entry["key"] == asked["alarm"])["acknowledged"] = seen
        return seen

    def write(self, asked):
        if "keep_s" in asked:
            self.asked.append(dict(asked))
        t_us = int(asked.get("t_us") or time.time_ns() // 1000)
        note = {"robot": asked["robot"], "t_us": t_us, "text": asked["text"], "by": "operator@lab"}
        self.notes.append({"id": f"{t_us:016d}-{len(self.notes):08x}", **note})
        self.notes.sort(key=lambda one: one["id"], reverse=True)
        return {"notes": self.notes}

    def delete(self, asked):
        self.notes = [one for one in self.notes if one["id"] != asked["id"]]
        return {"notes": self.notes}

    def motion(self, asked):
        names = [name for name in self.cars if asked.get("robot", name) == name]
        return {"robots": {name: self._entry(name) for name in names}, "user": "operator@lab", "failed": {}}

    def _entry(self, name):
        (told, stands), able = self.cars[name], name not in self.unstoppable
        return {
            "asked": told and able,
            "stopped": stands and able,
            "stands": stands and able,
            "stoppable": able,
            "why_not": "" if able else WHY_NOT,
            "reason": NO_MOTION if told and not able else "",
            "alone": told and name in self.alone,
            "by": "operator@lab" if told else "",
            "at_ms": round(NOW_S * 1000) if told else 0,
            "drive": LIMITS if name == "car-1" else None,
            "video": self.video if name == "car-1" else None,
        }

    def drive(self, asked):
        if self.broker is not None:
            return self.broker.address(asked)
        raise StationError("the role of a driver cannot be assumed")

    def socket(self, asked):
        if self.broker is None:
            raise StationError("the role of a viewer cannot be assumed")
        return self.broker.address(asked)

    def stop(self, asked):
        self.asked.append(dict(asked))
        told = asked["stopped"] == "true"
        if "robot" in asked:
            (self.alone.add if told else self.alone.discard)(asked["robot"])
        for name, car in self.cars.items():
            if asked.get("robot", name) == name and (told or name not in self.alone):
                car[:] = [told, told if self.confirms else car[1]]
        return self.motion(asked)

    def served(self):
        """What its server answers and does."""
        return {
            **({} if self.broker is None else {"broker": self.broker.origin}),
            "vehicles": {"car-1": {"speed_to_erpm_gain": GAIN}},
            "answers": self.answers(),
            "open_actions": {"acknowledge": self.acknowledge},
            "downloads": {"incident.mcap": self.download},
            "actions": {
                "send": lambda _: {"accepted": False, "reason": "stale", "after_ms": 300},
                "analyse": lambda _: {"run": "iort-1"},
                "note": self.write,
                "delete_note": self.delete,
                "keep": self.keep,
                "add_trigger": self.add_trigger,
                "remove_trigger": self.remove_trigger,
                "stop": self.stop,
                "drive": self.drive,
                "settings": lambda _: {"settings": SETTINGS, "online": False},
            },
        }

    def answers(self):
        presence = {"online": False, "since_ms": round(NOW_S - 3600) * 1000}
        return {
            "robots": lambda _: {"robots": {"car-1": {**presence, "online": True}, "car-9": presence}},
            "tags": lambda _: {"tags": {"car-1": {"lab": "north"}}},
            "vehicles": lambda _: {"vehicles": {}},
            "streams": lambda _: {"streams": self.streams},
            "fields": lambda _: FIELDS,
            "runs": lambda _: runs(),
            "history": history,
            "insights": insights,
            "notes": self.answer_notes,
            "incidents": self.answer_incidents,
            "incident_picture": self.picture,
            "incident_counts": lambda _: {"counts": {"car-1": len(self.incidents), "car-9": 1}},
            "triggers": lambda _: {"triggers": self.triggers},
            "dry_run": self.dry_run,
            "raceline": lambda _: {"x_m": [], "y_m": [], "lap_s": 0.0, "reason": "the page has no track"},
            "motion": self.motion,
            "socket": self.socket,
            "ice": lambda _: {"ice_servers": []},
            "laps": of_laps(analysis.laps),
            "delta": of_laps(analysis.delta),
            "dashboards": lambda _: {"dashboards": ["iort-platform"]},
            "dashboard": self.dashboard,
            "log": lambda _: {**LOG, "found": 1, "from_s": 0, "to_s": 60},
            "alarms": self.answer_alarms,
            "rejected": lambda _: {"found": 1, "rejected": [REJECTED]},
        }

    def dashboard(self, asked):
        to_s = int(NOW_S)
        times = [to_s - 600 + 60 * i for i in range(10)]
        line = {"label": "Published", "right": False, "times_s": times, "values": [*range(10)]}
        drawn = {"width": 24, "height": 5, "text": "", "period_s": 60}
        widgets = [
            {"kind": "text", "title": "", "text": "# The platform\nEverything at a glance."},
            {"kind": "alarms", "title": "Alarms", "alarms": self.alarms},
            {"kind": "number", "title": "Messages", "series": [line]},
            {
                "kind": "series",
                "title": "Live samples",
                "series": [line, {**line, "label": "Stale", "right": True}],
            },
            {"kind": "log", "title": "Newest warnings and errors"},
        ]
        placed = [
            {"series": [], "alarms": [], **drawn, **widget, "number": i, "x": 0, "y": 5 * i}
            for i, widget in enumerate(widgets)
        ]
        return {"name": asked["name"], "from_s": to_s - 3600, "to_s": to_s, "widgets": placed}


def runs():
    extent = {"from_us": round(NOW_S - 60) * 1_000_000, "to_us": round(NOW_S) * 1_000_000}
    part = {**extent, "batches": 60, "samples": 3000}
    run = {**extent, "run": "0a1b2c3d", "state": "running", "lost": 2, "streams": {VESC_STREAM: part}}
    return {"runs": [run], "older": True, "streams": {VESC_STREAM: extent}}


# The fields of its streams.
FIELDS = {
    "streams": {
        VESC_STREAM: {
            "numbers": [name for name, value in SAMPLE.items() if value is not None],
            "position": [],
            "degrees": False,
        },
        "pose": {"numbers": ["x", "y"], "position": ["x", "y"], "degrees": False},
    }
}


def history(asked):
    if asked["stream"] == "pose":
        return way(asked)
    start_s, end_s = int(asked["from_us"]) / 1e6, int(asked["to_us"]) / 1e6
    times = [start_s + (end_s - start_s) * i / 200 for i in range(200)]
    fields = {
        name: [value * math.sin(i / 9) for i in range(200)]
        for name, value in {**SAMPLE, _LONG: 1.5}.items()
        if isinstance(value, (int, float))
    }
    return past(times, fields, row_s=2)


def way(asked):
    """A circle of 5 m a minute, in steps of a quarter of a second."""
    start_s, end_s = int(asked["from_us"]) / 1e6, int(asked["to_us"]) / 1e6
    times = [start_s + i / 4 for i in range(round((end_s - start_s) * 4))]
    angles = [2 * math.pi * (at - start_s) / 60 for at in times]
    return past(times, {"x": [5 * math.cos(a) for a in angles], "y": [5 * math.sin(a) for a in angles]})


def past(times_s, fields, row_s=0):
    """The answer of columns of means."""
    columns = {name: {"mean": list(values)} for name, values in fields.items()}
    answer = {"times_s": times_s, "fields": columns, "samples": len(times_s), "row_s": row_s}
    return {**answer, "ros2": False, "archive": None, "refused": 0, "reason": ""}
