"""Scale: 1, 10, 100 and 500 robots, each with its own session, and the first bottleneck.

It runs only on the embedded cloud, which shares this machine's cores. The section on cost has AWS' quotas.
"""

from __future__ import annotations

from bench.load.fleet.figures import table
from bench.load.fleet.run import measure
from bench.report import plots
from bench.report.result import Section
from testkit.target import Say, Target

# Seconds that each fleet drives; a large fleet makes as many batches in less time.
FLEETS = {1: 10, 10: 10, 100: 10, 500: 4}


def run(target: Target, say: Say) -> Section:
    """Drive each fleet for some seconds: a batch of 50 samples a second and robot."""
    section = Section("scale", "Scale")
    if target.embedded is None:
        section.notes.append(
            "Not run on AWS: 500 robots would be registered in your account. What the quotas allow is in the "
            "section on cost."
        )
        return section
    runs = [
        measure(target.embedded, count, seconds, say, prefix="bench-scale")
        for count, seconds in FLEETS.items()
    ]
    section.tables.append(table(runs))
    section.ratio("samples lost in all fleets", sum(run.samples_lost for run in runs), 0, unit="samples")
    last = runs[-1]
    busiest = max(last.cpu_percent, key=lambda part: last.cpu_percent[part])
    section.notes.append(
        f"With {last.robots} robots the part that works most is the {busiest}, at "
        f"{last.cpu_percent[busiest]:.0f} % of a core; Lambda 2 was done {last.catch_up_s:.0f} s after the "
        "last batch. All share this machine's cores, the robots as well."
    )
    counts = [float(run.robots) for run in runs]
    cpu = {part: [run.cpu_percent[part] for run in runs] for part in last.cpu_percent}
    title = "CPU by part, in percent of a core"
    section.plot("scale-cpu", title, plots.lines(counts, cpu, x_label="robots", y_label="%"))
    delays = {
        "robot to rule": [run.delay_ms.p95 or 0.0 for run in runs],
        "robot to acknowledgement": [run.ack_ms.p95 or 0.0 for run in runs],
    }
    title = "Robot to rule and to acknowledgement, p95"
    section.plot("scale-delay", title, plots.lines(counts, delays, x_label="robots", y_label="ms"))
    section.raw = {"runs": [run.as_json() for run in runs]}
    return section
