"""Scale: 1, 10, 100 and 500 robots, each with its own session, and the first bottleneck.

It runs only on the embedded cloud, which shares this machine's cores. The section on cost has AWS' quotas.
"""

from __future__ import annotations

from bench.load import fleet_run
from bench.report import plots
from bench.report.result import Plot, Ratio, Section, Table
from bench.target import Say, Target

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
    runs = []
    for count, seconds in FLEETS.items():
        said = {"last": ""}

        def tell(share: float, what: str, count: int = count, said: dict[str, str] = said) -> None:
            text = f"{count} robots, {what}"
            if said["last"] != text or share >= 1:
                said["last"] = text
                say(text)

        runs.append(fleet_run.measure(target.embedded, count, seconds, tell, prefix="bench-scale"))
    _report(section, runs)
    return section


def _report(section: Section, runs: list[fleet_run.Fleet]) -> None:
    parts = list(runs[0].cpu_percent)
    section.tables.append(
        Table(
            "Robots with a certificate and a session each, a batch of 50 samples a second",
            ["", *(f"{run.robots} robot{'s' * (run.robots > 1)}" for run in runs)],
            [
                ["seconds", *(str(run.seconds) for run in runs)],
                ["samples sent", *(f"{run.samples_sent:,}" for run in runs)],
                ["samples lost", *(f"{run.samples_lost:,}" for run in runs)],
                ["out of order", *(str(run.topics_out_of_order) for run in runs)],
                ["robot to rule", *(str(run.delay_ms) for run in runs)],
                ["robot to acknowledgement", *(str(run.ack_ms) for run in runs)],
                ["Lambda 2 done after the last batch", *(f"{run.catch_up_s:.1f} s" for run in runs)],
                *([f"CPU, {part}", *(f"{run.cpu_percent[part]:.0f} %" for run in runs)] for part in parts),
                *([f"memory, {part}", *(f"{run.rss_mb[part]:.0f} MB" for run in runs)] for part in parts),
            ],
        )
    )
    lost = sum(run.samples_lost for run in runs)
    section.ratios.append(Ratio("samples lost in all fleets", lost, 0, "samples"))
    last = runs[-1]
    busiest = max(last.cpu_percent, key=lambda part: last.cpu_percent[part])
    section.notes.append(
        f"With {last.robots} robots the part that works most is the {busiest}, at "
        f"{last.cpu_percent[busiest]:.0f} % of a core; Lambda 2 was done {last.catch_up_s:.0f} s after the "
        "last batch. All share this machine's cores, the robots as well."
    )
    counts = [float(run.robots) for run in runs]
    title = "CPU by part, in percent of a core"
    series = {part: [run.cpu_percent[part] for run in runs] for part in parts}
    section.plots.append(
        Plot("scale-cpu", title, plots.lines(title, counts, series, x_label="robots", y_label="%", log=True))
    )
    title = "Robot to rule and to acknowledgement, p95"
    delays = {
        "robot to rule": [run.delay_ms.p95 or 0.0 for run in runs],
        "robot to acknowledgement": [run.ack_ms.p95 or 0.0 for run in runs],
    }
    section.plots.append(
        Plot(
            "scale-delay", title, plots.lines(title, counts, delays, x_label="robots", y_label="ms", log=True)
        )
    )
    section.raw = {"runs": [run.as_json() for run in runs]}
