"""What a program may ask of robots and recordings: a method is a tool of `iort mcp`, its docstring what the
client reads of it.

An answer says what was ``asked`` with absolute times, of how many ``samples`` it is, and the ``audit``'s word
about the range, so that every number can be recomputed. It is small: what is cut is said in ``cut``, and what
would be too large to read is refused with what to do. Texts that a robot or a person wrote, also the names of
fields, stand in ``robot_text`` alone: they are data.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from itertools import islice
from typing import Annotated, Any, TypeAlias

from pydantic import Field

from iort_analysis.samples.blocks import values
from iort_contract.catalog.analysis import LAPS_TABLE
from iort_contract.limits import Value
from iort_contract.messages.analysis import encode_finding
from iort_contract.tables import NO_ROBOT
from iort_station.cloud import Cloud
from iort_station.cost import report
from iort_station.cost.usage import Usage
from iort_station.data import inventory
from iort_station.data.figures import bins, check_figure, figure
from iort_station.data.queries import Result, query
from iort_station.data.recorded import select
from iort_station.data.runs import laps_of_runs
from iort_station.errors import UsageError
from iort_station.fleet import registry
from iort_station.lab import Lab
from iort_station.operations import quarantine
from iort_station.operations.verdict import Verdict, overlap, verdict
from iort_station.times import between_hours, duration_us, iso, stamped

# What an answer reads at most: batches of a stream, values that stay, the time between start and end.
MOST_BATCHES, MOST_VALUES = 20_000, 5_000_000
_DAY_US = 86_400_000_000
MOST_SAMPLES_US, MOST_FACTS_US = 31 * _DAY_US, 366 * _DAY_US
# What an answer has at most: rows or groups, facts in a list, characters of a text, bytes.
MOST_ROWS, MOST_LISTED, MOST_TEXT, MOST_BYTES = 500, 50, 1000, 400_000

Name: TypeAlias = Annotated[str, Field(min_length=1, max_length=64)]
When: TypeAlias = Annotated[
    str, Field(max_length=40, description="-10m, -2d, now, or ISO 8601 such as 2026-05-04T10:00:00Z")
]
Names: TypeAlias = Annotated[list[Annotated[str, Field(max_length=256)]], Field(max_length=32)]
Condition: TypeAlias = Annotated[
    str, Field(max_length=400, description="for example: speed_mps > 1.2 and fault_code == 0")
]
Duration: TypeAlias = Annotated[str, Field(max_length=16, description="100ms, 1s, 1m, 1h")]
Statistics: TypeAlias = Annotated[
    list[Annotated[str, Field(max_length=8)]],
    Field(max_length=12, description="count, min, max, mean, sum, first, last, p50, p95 ..."),
]
Facts: TypeAlias = dict[str, Any]


def said(text: str) -> Facts:
    """A text that a robot or a person wrote, as data."""
    if len(text) <= MOST_TEXT:
        return {"robot_text": text}
    return {"robot_text": text[:MOST_TEXT], "cut": f"{MOST_TEXT:,} of {len(text):,} characters"}


def _value(value: Value) -> Any:
    return said(value) if isinstance(value, str) else value


class Inquiries:
    """The tools over a deployment. Every one raises `StationError`, also for more than ``most_batches`` of a
    stream."""

    def __init__(self, cloud: Cloud, *, most_batches: int = MOST_BATCHES) -> None:
        self._cloud, self._lab, self._most = cloud, Lab(cloud), most_batches

    def robots(self) -> Facts:
        """The registered robots, and whether each is connected."""
        found = self._lab.robots()
        rows = [
            {
                "robot": said(one.name),
                "online": one.online,
                **stamped("since", one.since_us),
                "speed_to_erpm_gain": one.speed_to_erpm_gain,
            }
            for one in found
        ]
        return _listed("robots", rows, {}, _no_samples("facts of the registry"), most=MOST_ROWS)

    def streams(self, robot: Name) -> Facts:
        """A robot's streams: when they begin and end, and their fields with units."""
        rows = [
            {
                "stream": said(one.name),
                **_between(one.from_us, one.to_us),
                "runs": one.runs,
                "fields": [{"field": said(name), "unit": unit or None} for name, unit in one.fields.items()],
            }
            for one in self._lab.streams(robot)
        ]
        word = _no_samples("times and names of fields; the tool audit tells what is missing")
        return _listed("streams", rows, {"robot": robot}, word, most=MOST_ROWS)

    def query(
        self,
        robot: Name,
        stream: Name,
        *,
        start: When = "-1h",
        end: When = "now",
        fields: Names | None = None,
        where: Condition | None = None,
        every: Duration | None = None,
        statistics: Statistics | None = None,
        per: Annotated[
            str, Field(max_length=16, description="range, run, lap, or a time such as 1m")
        ] = "range",
    ) -> Facts:
        """Samples of a stream, or their statistics over the range, per run, per lap or per stretch of time.

        The range includes its start and excludes its end. speed_mps and power_w are derived fields. Without
        statistics the first 500 rows are given; every averages samples. Where you need a number, ask for
        statistics.
        """
        start_us, end_us = _range(start, end, MOST_SAMPLES_US)
        for name in statistics or ():
            check_figure(name)
        if per != "range" and not statistics:
            raise UsageError(f"per {per} needs statistics, for example mean")
        if every is not None and statistics:
            raise UsageError("give every for averaged rows, or statistics; per groups statistics by time")
        result = query(
            self._cloud,
            robot,
            stream,
            start_us,
            end_us,
            fields=fields,
            where=where,
            every=every,
            most=MOST_VALUES,
            progress=_bounded(self._most),
        )
        refused = (result.refused, result.reason)
        word = verdict(self._cloud, robot, stream, start_us, end_us, refused=refused, most=self._most)
        command = ["iort", "query", robot, stream, "--from", iso(start_us), "--to", iso(end_us)]
        for option, given in (
            ("--fields", fields and ",".join(fields)),
            ("--where", where),
            ("--every", every),
        ):
            command += [option, given] if given else []
        asked = {
            "robot": robot,
            "stream": stream,
            **_between(start_us, end_us),
            "fields": fields,
            "where": where,
        }
        asked |= {"every": every, "statistics": statistics, "per": per, "recompute": shlex.join(command)}
        archived = result.origin.told()
        facts: Facts = {
            "samples": result.samples,
            "refused": result.refused,
            "null_as_no_sensor": [{"field": said(name), "values": n} for name, n in result.absent.items()],
            "from_archive": archived and between_hours(archived),
        }
        if not statistics:
            return _answer(asked, _audit(word), **facts, **_rows(result))
        stretches, cut = self._groups(robot, result, start_us, end_us, per)
        groups = [
            {
                **_between(first_us, last_us),
                **about,
                **_figures(result, first_us, last_us, statistics),
            }
            for first_us, last_us, about in stretches
        ]
        return _answer(asked, _audit(word), cut=cut, **facts, groups=groups)

    def _groups(
        self, robot: str, result: Result, start_us: int, end_us: int, per: str
    ) -> tuple[list[tuple[int, int, Facts]], list[str | Facts]]:
        """The stretches of time of the statistics, and what they leave out."""
        found: list[tuple[int, int, Facts]]
        cut: list[str | Facts] = []
        if per == "range":
            found = [(start_us, end_us, {})]
        elif per == "run":
            runs = reversed(self._lab.runs(robot, start_us, end_us, count=MOST_ROWS + 1))
            found = [
                (max(one.from_us, start_us), min(one.to_us, end_us), {"run": one.id, "state": one.state})
                for one in runs
            ]
            if overlap(self._cloud, robot, result.stream, start_us, end_us):
                cut.append("runs overlap in time: a group has the samples of all of them")
        elif per == "lap":
            found = []
            if len(self._lab.runs(robot, start_us, end_us, count=MOST_LISTED + 1)) > MOST_LISTED:
                raise UsageError(
                    f"the range has more than {MOST_LISTED} runs, of which laps are searched: choose a "
                    "shorter one"
                )
            for run in laps_of_runs(
                self._cloud, robot, start_us, end_us, count=MOST_LISTED, progress=_bounded(self._most)
            ):
                table = run.mined.tables.get(LAPS_TABLE)
                if table is None or not len(table["lap"]):
                    reasons = "; ".join(run.mined.missing.values()) or "none was found"
                    cut.append(said(f"run {run.run} has no laps: {reasons}"))
                    continue
                starts = table["start_us"].tolist()
                # A lap ends where the next one begins.
                ends = [*starts[1:], starts[-1] + round(float(table["time_s"][-1]) * 1e6)]
                for first_us, last_us, lap, complete in zip(
                    starts, ends, table["lap"].tolist(), table["complete"].tolist(), strict=True
                ):
                    found.append((first_us, last_us, {"run": run.run, "lap": lap, "complete": complete}))
        else:
            # The range may cut the first and the last one.
            found = [
                (max(first_us, start_us), min(last_us, end_us), {})
                for first_us, last_us in bins(result.times_us, duration_us(per))
            ]
        if len(found) > MOST_ROWS:
            raise UsageError(
                f"per {per} gives {len(found):,} groups, at most {MOST_ROWS} are sent: choose a longer one, "
                "or a shorter range"
            )
        return found, cut

    def runs(
        self,
        robot: Name,
        start: When = "-7d",
        end: When = "now",
        count: Annotated[int, Field(ge=1, le=20)] = 5,
    ) -> Facts:
        """The newest runs of a robot's agent in a range: when, how each ended, and what it recorded of each
        stream, with the audit's word about each."""
        start_us, end_us = _range(start, end, MOST_FACTS_US)
        rows = []
        found = self._lab.runs(robot, start_us, end_us, count=count + 1)
        for one in found[:count]:
            streams = []
            for name, part in one.streams.items():
                first_us, last_us = part["from_us"] or 0, part["to_us"] or 0
                word = verdict(self._cloud, robot, name, first_us, last_us, refused=(0, ""), most=self._most)
                counts = {"samples": part["samples"], "batches": part["batches"]}
                streams.append(
                    {"stream": said(name), **_between(first_us, last_us), **counts, "audit": _audit(word)}
                )
            about = {"run": one.id, **_between(one.from_us, one.to_us), "state": one.state, "lost": one.lost}
            rows.append({**about, "streams": streams})
        asked = {"robot": robot, **_between(start_us, end_us), "count": count}
        more = [f"the newest {count} runs; there are older ones in the range"] if len(found) > count else []
        word_of_all = _no_samples("each stream of a run has its own word; samples are the agent's own count")
        return _answer(asked, word_of_all, samples=None, runs=rows, cut=more)

    def findings(self, robot: Name | None = None, start: When = "-7d", end: When = "now") -> Facts:
        """What the analysis found about drives, the newest first: kind, severity, effect with its 90 %
        interval, and the stretch of the stream that is the evidence, with the audit's word about it."""
        start_us, end_us = _range(start, end, MOST_FACTS_US)
        found = self._lab.findings(robot, start_us, end_us, count=MOST_LISTED + 1)
        rows = []
        for one in found[:MOST_LISTED]:
            facts = encode_finding(one)
            texts = {name: said(str(facts.pop(name))) for name in ("robot", "text", "subject", "stream")}
            del facts["from_us"], facts["to_us"]
            facts["fields"] = list(map(said, one.fields))
            word = _no_samples("the finding is of no stream")
            if one.stream:
                about = (one.drive.robot, one.stream, one.from_us, one.to_us + 1)
                word = _audit(verdict(self._cloud, *about, refused=(0, ""), most=self._most))
            rows.append(
                {**facts, **texts, "id": said(one.id), **_between(one.from_us, one.to_us), "audit": word}
            )
        asked = {"robot": robot, **_between(start_us, end_us)}
        return _listed("findings", rows, asked, _no_samples("each finding has its own word"), len(found))

    def incidents(self, robot: Name | None = None, start: When = "-7d", end: When = "now") -> Facts:
        """What robots' event recorders have kept, the newest first: trigger, state, size, and how many
        messages of the window are missing in the file."""
        start_us, end_us = _range(start, end, MOST_FACTS_US)
        rows = []
        for one in self._lab.incidents(robot, start_us, end_us):
            left_out = {"from_us", "to_us", "changed_us"}
            facts = {name: _value(value) for name, value in asdict(one).items() if name not in left_out}
            times = {**_between(one.from_us, one.to_us), **stamped("changed", one.changed_us)}
            lost = one.missing or one.state in {"lost", "over_budget"}
            word = "incomplete" if lost else "complete" if one.state == "uploaded" else "unknown"
            why = f"by the recorder's own account: {one.missing:,} messages missing, state {one.state}"
            rows.append({**facts, **times, "audit": {"word": word, "why": [said(why)]}})
        asked = {"robot": robot, **_between(start_us, end_us)}
        return _listed("incidents", rows, asked, _no_samples("each incident has its own word"))

    def audit(
        self, robot: Name, streams: Names | None = None, start: When = "-1h", end: When = "now"
    ) -> Facts:
        """Whether everything that a robot recorded in a range is stored, stream by stream: complete,
        incomplete or unknown, and why."""
        start_us, end_us = _range(start, end, MOST_SAMPLES_US)
        rows = []
        for name in streams or inventory.check_recorded(self._cloud, robot):
            select(robot, name)
            word = verdict(self._cloud, robot, name, start_us, end_us, most=self._most)
            if not word.batches:
                inventory.check_there(self._cloud, robot, name)
            counts = {"batches": word.batches, "missing_batches": word.missing}
            rows.append({"stream": said(name), **counts, "audit": _audit(word)})
        asked = {"robot": robot, "streams": streams, **_between(start_us, end_us)}
        return _listed("streams", rows, asked, _no_samples("each stream has its own word"))

    def errors(self, robot: Name | None = None, start: When = "-7d", end: When = "now") -> Facts:
        """The messages that the cloud refused, the newest first: where, why, and how often."""
        start_us, end_us = _range(start, end, MOST_FACTS_US)
        entries = quarantine.entries(self._cloud, robot=robot, since_ms=start_us // 1000)
        found = list(islice(entries, self._most + 1))
        if not found and robot not in {None, NO_ROBOT}:
            registry.get(self._cloud, str(robot))
        inside = (one for one in found[: self._most] if one.first_ms * 1000 < end_us)
        newest = sorted(inside, key=lambda one: (-one.last_ms, one.id))
        rows = [
            {
                **{name: said(getattr(one, name)) for name in ("id", "robot", "topic", "reason")},
                "source": one.source,
                "seen": one.seen,
                "replays": one.replays,
                **stamped("first", one.first_ms * 1000),
                **stamped("last", one.last_ms * 1000),
            }
            for one in newest[:MOST_LISTED]
        ]
        waiting = asdict(quarantine.waiting(self._cloud))
        asked = {"robot": robot, **_between(start_us, end_us)}
        facts = _listed("errors", rows, asked, _no_samples("messages that are no samples"), len(newest))
        if len(found) > self._most:
            facts["cut"].append(f"only {self._most:,} messages of the quarantine were looked at, in no order")
        return {**facts, "waiting": waiting}

    def cost(
        self,
        robots: Annotated[int, Field(ge=1, le=100_000)] = 1,
        rate_hz: Annotated[float, Field(gt=0, le=10_000)] = 50.0,
        streams: Annotated[int, Field(ge=1, le=1000)] = 1,
        hours_per_day: Annotated[float, Field(ge=0, le=24)] = 2.0,
    ) -> Facts:
        """What a fleet costs on AWS at list prices, by service: an estimate by the model, not a bill."""
        given = Usage(robots=robots, rate_hz=rate_hz, streams=streams, hours_per_day=hours_per_day)
        usage = Usage(**{**vars(given), "watched_hours": hours_per_day}).check()
        asked = {"robots": robots, "rate_hz": rate_hz, "streams": streams, "hours_per_day": hours_per_day}
        return _answer(
            asked,
            _no_samples("list prices and assumptions, nothing measured"),
            samples=None,
            **report.facts(usage),
        )


def _answer(asked: Facts, audit: Facts, *, cut: Sequence[str | Facts] = (), **facts: Any) -> Facts:
    return {"asked": asked, "audit": audit, "cut": list(cut), **facts}


def _listed(
    name: str, rows: list[Facts], asked: Facts, audit: Facts, there: int = 0, *, most: int = MOST_LISTED
) -> Facts:
    cut = []
    if max(len(rows), there) > most:
        cut = [f"the first {most} {name}, and there are more: ask for one robot or a shorter range"]
    return _answer(asked, audit, samples=None, cut=cut, **{name: rows[:most]})


def _audit(word: Verdict) -> Facts:
    # A reason may quote what a robot has written.
    return {"word": word.word, "why": [said(one) for one in word.why[:10]]}


def _no_samples(why: str) -> Facts:
    return {"word": "unknown", "why": [why]}


def _between(from_us: int, to_us: int) -> Facts:
    return {**stamped("from", from_us), **stamped("to", to_us)}


def _range(start: str, end: str, most_us: int) -> tuple[int, int]:
    chosen = select("robot", "stream", start, end)
    start_us, end_us = chosen.start_us or 0, chosen.end_us or 0
    if end_us - start_us > most_us:
        days = most_us // _DAY_US
        raise UsageError(f"the range must be at most {days} days, got {(end_us - start_us) / _DAY_US:,.1f}")
    return start_us, end_us


def _bounded(most: int) -> Callable[[int, int], None]:
    """Progress of a reading that ends it at too many batches."""
    read = 0

    def progress(more: int, last_us: int) -> None:
        nonlocal read
        read += more
        if read > most:
            raise UsageError(
                f"the range has more than {most:,} batches, and was read to {iso(last_us)}: choose a "
                "shorter one"
            )

    return progress


def _rows(result: Result) -> Facts:
    """The first rows by columns, whose names are a robot's."""
    shown, whole = min(len(result), MOST_ROWS), len(result)
    columns = [
        {
            "field": said(name),
            "unit": result.unit(name) or None,
            "values": list(map(_value, values(column[:shown]))),
        }
        for name, column in result.columns.items()
    ]
    cut = [f"the first {shown} of {whole:,} rows: statistics are of all of them"] if shown < whole else []
    return {"rows": whole, "times_us": result.times_us[:shown].tolist(), "columns": columns, "cut": cut}


def _figures(result: Result, first_us: int, last_us: int, statistics: Iterable[str]) -> Facts:
    """The statistics of every column from a time to before another."""
    first, last = (int(result.times_us.searchsorted(each)) for each in (first_us, last_us))
    figures = []
    for name, column in result.columns.items():
        for statistic in statistics:
            try:
                # The field's own name is a robot's word.
                value, count = figure(statistic, "a field", column[first:last])
            except UsageError as error:
                error.nearest = (name,)
                raise
            unit = None if statistic == "count" else result.unit(name) or None
            about = {"field": said(name), "statistic": statistic, "unit": unit}
            figures.append({**about, "value": _value(value), "values": count})
    return {"samples": last - first, "figures": figures}
