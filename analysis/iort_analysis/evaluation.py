"""The evaluation: what differs from the robot's own earlier drives, or from the fleet's."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np

from iort_analysis.baselines import US_PER_DAY, Baseline, baseline, fleet_baseline, trend
from iort_analysis.results import DriveResult, Event, Measured
from iort_contract.catalog.analysis import KINDS, PARAMETERS
from iort_contract.catalog.entries import Parameter
from iort_contract.messages.analysis import DriveKey, Estimate, Finding


def false_discovery_rates(p_values: Sequence[float]) -> list[float]:
    """For each test the rate of false discoveries among all that are at least as significant.

    By Benjamini and Yekutieli: right whatever the tests have to do with each other, and the parameters of one
    drive have much.
    """
    p = np.asarray(p_values, dtype=float)
    if not len(p):
        return []
    order = np.argsort(p, kind="stable")
    ranks = np.arange(1, len(p) + 1)
    scaled = p[order] * len(p) * (1 / ranks).sum() / ranks
    rates = np.empty(len(p))
    rates[order] = np.minimum(1.0, np.minimum.accumulate(scaled[::-1])[::-1])
    found: list[float] = rates.tolist()
    return found


# The sentences of findings.


def changed(parameter: Parameter, found: Estimate, expected: Baseline, whose: str) -> str:
    """What a parameter is, and what was expected."""
    over = f"{expected.drives} {'earlier drives' if whose == 'its own' else 'other robots'}"
    return (
        f"{parameter.meaning}: {_with_interval(found)}, "
        f"{_compared(found.value - expected.value, expected.value, found.unit)} {whose} baseline of "
        f"{_number(expected.value, found.unit)} over {over}"
    )


def trending(parameter: Parameter, newest: Estimate, change: Estimate, days: float) -> str:
    """How a parameter developed."""
    way = "rose" if change.value > 0 else "fell"
    low, high = sorted((abs(change.low), abs(change.high)))
    by = f"{_number(abs(change.value), change.unit)} ({_digits(low)} to {_digits(high)})"
    return f"{parameter.meaning}: {way} by {by} in {days:.0f} days, to {_number(newest.value, newest.unit)}"


def complete(finding: Finding, explained: Sequence[Finding]) -> str:
    """The finding's text with the others that it explains, and with what else the cause may be."""
    sentences = [finding.text]
    if explained:
        sentences.append("This goes with it: " + "; ".join(other.text for other in explained))
    if alternatives := KINDS[finding.kind].alternatives:
        sentences.append(f"The data cannot tell this from {' or '.join(alternatives)}")
    return ". ".join(sentences)


def rounded(estimate: Estimate) -> Estimate:
    """The estimate with the digits that it deserves: three of its interval's width, or six without one."""
    size = estimate.high - estimate.low or 1e-3 * abs(estimate.value)
    if not size:
        return estimate
    places = 2 - math.floor(math.log10(size))
    value, low, high = (round(float(each), places) for each in estimate[:3])
    return Estimate(value, low, high, estimate.unit)


def _with_interval(estimate: Estimate) -> str:
    value, low, high, unit = estimate
    return f"{_number(value, unit)} ({_digits(low)} to {_digits(high)})"


def _compared(change: float, baseline: float, unit: str) -> str:
    way = "above" if change > 0 else "below"
    # A share of nearly nothing says nothing.
    if abs(baseline) > abs(change) / 10:
        return f"{abs(change / baseline):.0%} {way}"
    return f"{_number(abs(change), unit)} {way}"


def _number(value: float, unit: str) -> str:
    return _digits(value) if unit == "1" else f"{_digits(value)} {unit}"


def _digits(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


# From the results of drives to findings.

# A finding counts up to this rate of false discoveries among those of one evaluation.
FALSE_DISCOVERY_RATE = 0.05
# With fewer earlier drives of its own, a robot is compared with the fleet; and with fewer robots, not at all.
MIN_DRIVES = MIN_ROBOTS = 3
# A baseline is of the newest drives: a car is repaired and changed.
_RECENT = 50
# A drive as unlikely as this takes no part in the baseline of the next one.
_UNUSUAL = 1e-3
_PLACES = {name: place for place, name in enumerate(PARAMETERS)}
# A trend needs so many drives, over so many days.
_TREND_DRIVES, _TREND_DAYS = 8, 5


def evaluate(
    results: Sequence[DriveResult], history: Sequence[Measured], fleet: Sequence[Measured]
) -> list[Finding]:
    """The findings about one robot's drives, in order of time.

    ``history`` are the robot's other drives, and ``fleet`` those of other robots; for each result only the
    earlier ones count. The same arguments in any order give the same findings.
    """
    candidates: list[Finding] = []
    results = sorted(results, key=lambda result: str(result.drive))
    own = {measured.drive: measured for measured in history}
    for result in results:
        own.pop(result.drive, None)
    others = sorted(fleet, key=lambda one: (one.drive.robot, str(one.drive)))
    for result in results:
        earlier = sorted(_before(own.values(), result.drive), key=lambda one: str(one.drive))
        changes, unusual = _changes(result, earlier, _before(others, result.drive))
        candidates += changes
        if result is results[-1]:
            candidates += _trends(result, earlier)
        candidates += [_of_event(result, event) for event in result.mined.events]
        usual = {name: e for name, e in result.mined.estimates.items() if name not in unusual}
        own[result.drive] = Measured(result.drive, usual)
    return _explained(_discovered(candidates))


def _changes(
    result: DriveResult, earlier: Sequence[Measured], fleet: Sequence[Measured]
) -> tuple[list[Finding], set[str]]:
    """The estimates of a drive that changed, and the names of those that are unusual."""
    findings: list[Finding] = []
    unusual: set[str] = set()
    for name, found in sorted(result.mined.estimates.items()):
        # A result may be of another version of the analysis.
        parameter = PARAMETERS.get(name)
        expected = parameter and _expected(parameter, earlier, fleet)
        if not parameter or not expected:
            continue
        usual, whose = expected
        effect, p_up, p_down = usual.change(found)
        if min(p_up, p_down) < _UNUSUAL:
            unusual.add(name)
        if parameter.kind:
            text, at = changed(parameter, found, usual, whose), usual.interval(found.unit)
            p = _chance(parameter, p_up, p_down)
            findings.append(_of_parameter(result, parameter, text, effect=effect, baseline=at, p=p))
    return findings, unusual


def _chance(parameter: Parameter, p_up: float, p_down: float) -> float:
    """The chance of such a change for the worse."""
    return {"up": p_up, "down": p_down, "either": 2 * min(p_up, p_down)}[parameter.worse]


def _expected(
    parameter: Parameter, earlier: Sequence[Measured], fleet: Sequence[Measured]
) -> tuple[Baseline, str] | None:
    """The baseline of a parameter and whose it is; None if too few drives have it."""
    own = [one.estimates[parameter.name] for one in earlier if parameter.name in one.estimates][-_RECENT:]
    if len(own) >= MIN_DRIVES:
        return baseline(own, _spread(parameter, own)), "its own"
    having = (one for one in fleet if parameter.name in one.estimates)
    robots = [
        [one.estimates[parameter.name] for one in drives]
        for _, drives in groupby(having, key=lambda one: one.drive.robot)
    ]
    if len(robots) >= MIN_ROBOTS:
        return fleet_baseline(
            robots, _spread(parameter, [e for drives in robots for e in drives])
        ), "the fleet's"
    return None


def _spread(parameter: Parameter, estimates: Sequence[Estimate]) -> float:
    """What a healthy car's drives differ by, by the catalogue."""
    middle = sorted(estimate.value for estimate in estimates)[len(estimates) // 2]
    return parameter.least_change(middle) / 4


def _trends(result: DriveResult, earlier: Sequence[Measured]) -> Iterable[Finding]:
    """The parameters that grew worse over the last drives, up to this one."""
    drives = [*earlier, Measured(result.drive, result.mined.estimates)]
    for name, newest in sorted(result.mined.estimates.items()):
        parameter = PARAMETERS.get(name)
        having = [one for one in drives if name in one.estimates]
        days = (having[-1].drive.start_us - having[0].drive.start_us) / US_PER_DAY
        if not parameter or not parameter.kind or len(having) < _TREND_DRIVES or days < _TREND_DAYS:
            continue
        found = trend(
            [one.drive.start_us for one in having],
            [one.estimates[name].value for one in having],
            newest.unit,
        )
        slope, low, high, _ = found.per_day
        effect = Estimate(slope * found.days, low * found.days, high * found.days, newest.unit)
        text, at = trending(parameter, newest, effect, found.days), having[0].estimates[name]
        p = min(1.0, _chance(parameter, found.p_up, found.p_down))
        finding = _of_parameter(result, parameter, text, effect=effect, baseline=at, p=p)
        yield replace(finding, subject=f"{name}_trend")


def _of_parameter(
    result: DriveResult, parameter: Parameter, text: str, *, effect: Estimate, baseline: Estimate, p: float
) -> Finding:
    return Finding(
        drive=result.drive,
        kind=parameter.kind,
        severity=KINDS[parameter.kind].severity,
        subject=parameter.name,
        from_us=result.drive.start_us,
        to_us=result.end_us,
        stream=result.vesc,
        fields=parameter.fields,
        text=text,
        effect=rounded(effect),
        baseline=rounded(baseline),
        p=p,
    )


def _of_event(result: DriveResult, event: Event) -> Finding:
    return Finding(
        drive=result.drive,
        kind=event.kind,
        severity=KINDS[event.kind].severity,
        subject=event.kind,
        from_us=event.start_us,
        to_us=event.end_us,
        stream=event.stream,
        fields=event.fields,
        text=event.text,
        effect=None if event.effect is None else rounded(event.effect),
        p=event.p,
    )


def _discovered(candidates: Sequence[Finding]) -> list[Finding]:
    """Those that are neither chance nor weak. A candidate without a chance was judged by its miner."""
    tested = [finding for finding in candidates if finding.p is not None]
    rates = false_discovery_rates([finding.p for finding in tested if finding.p is not None])
    found = [
        replace(finding, q=rate)
        for finding, rate in zip(tested, rates, strict=True)
        if rate <= FALSE_DISCOVERY_RATE and not _weak(finding)
    ]
    return found + [finding for finding in candidates if finding.p is None]


def _weak(finding: Finding) -> bool:
    parameter = PARAMETERS.get(finding.subject.removesuffix("_trend"))
    if parameter is None or finding.effect is None or finding.baseline is None:
        return False
    return abs(finding.effect.value) < parameter.least_change(finding.baseline.value)


def _explained(findings: Iterable[Finding]) -> list[Finding]:
    """One finding a cause: what else the same cause changed in the drive is told in its text."""
    kept: list[Finding] = []
    by_drive = sorted(findings, key=lambda finding: finding.id)
    for _, group in groupby(by_drive, key=lambda finding: str(finding.drive)):
        kinds: dict[str, list[Finding]] = {}
        for finding in group:
            kinds.setdefault(finding.kind, []).append(finding)
        explained = {kind for found in kinds for kind in KINDS[found].explains}
        for kind in kinds.keys() - explained:
            changes = [finding for finding in kinds[kind] if _is_change(finding)]
            events = [finding for finding in kinds[kind] if not _is_change(finding)]
            # Several parameters that changed are one cause; events have their own times. The catalogue's
            # order keeps the finding's id when the drive is analysed again with more history.
            first, *beside = sorted(changes, key=_place) or events
            beside = [] if first in events else beside
            beside += [other for name in KINDS[kind].explains for other in kinds.get(name, ())]
            kept += [replace(first, text=complete(first, beside))]
            kept += [event for event in events if event is not first]
    return sorted(kept, key=lambda finding: finding.id)


def _is_change(finding: Finding) -> bool:
    return finding.subject.removesuffix("_trend") in PARAMETERS


def _place(finding: Finding) -> tuple[int, str]:
    return _PLACES[finding.subject.removesuffix("_trend")], finding.subject


def _before(measured: Iterable[Measured], drive: DriveKey) -> list[Measured]:
    return [one for one in measured if one.drive.start_us < drive.start_us]
