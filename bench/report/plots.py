"""The report's pictures: small SVGs, legible in black on white and for colour-blind readers."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import matplotlib as mpl
from matplotlib.figure import Figure

# Okabe and Ito's colours.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_LINES = ("-", "--", "-.", ":")
# A curve of thousands of points looks the same with a hundred.
_POINTS = 100


def cdf(title: str, curves: Mapping[str, Sequence[float]], *, unit: str = "ms") -> str:
    """The share of values up to each value, on a logarithmic axis."""
    figure, axes = _figure(title)
    for i, (name, values) in enumerate((name, values) for name, values in curves.items() if values):
        ordered = sorted(values)
        at = [round(k * (len(ordered) - 1) / (_POINTS - 1)) for k in range(_POINTS)]
        axes.plot(
            [ordered[k] for k in at],
            [(k + 1) / len(ordered) for k in at],
            _LINES[i % 4],
            color=COLOURS[i % 7],
            label=name,
            linewidth=1.6,
        )
    axes.set_xscale("log")
    axes.set_xlabel(unit)
    axes.set_ylabel("share of messages")
    axes.set_ylim(0, 1.01)
    axes.grid(visible=True, which="both", linewidth=0.3)
    axes.legend(fontsize=8, loc="lower right")
    return _svg(figure)


def bars(title: str, values: Mapping[str, float], *, unit: str, log: bool = False) -> str:
    """One bar for each name, with its value at the end."""
    figure, axes = _figure(title, height=0.42 * len(values) + 1.0)
    names = list(values)
    axes.barh(names, [values[name] for name in names], color=[COLOURS[i % 7] for i in range(len(names))])
    axes.invert_yaxis()
    if log:
        axes.set_xscale("log")
    for i, name in enumerate(names):
        axes.annotate(
            f" {values[name]:,.3g}", (values[name], i), va="center", fontsize=8, annotation_clip=False
        )
    axes.set_xlabel(unit)
    axes.margins(x=0.18)
    return _svg(figure)


def ranges(
    title: str, names: Sequence[str], series: Mapping[str, Mapping[str, tuple[float, float]]], *, unit: str
) -> str:
    """One row for each name, with a bar from least to most for each series that has the name."""
    figure, axes = _figure(title, height=0.5 * len(names) + 1.0)
    thick = 0.8 / len(series)
    longest = max(most for bars in series.values() for _, most in bars.values())
    for i, (label, bars) in enumerate(series.items()):
        at = [names.index(name) + (i - (len(series) - 1) / 2) * thick for name in bars]
        left = [least for least, _ in bars.values()]
        # An empty range must be visible too.
        wide = [max(most - least, longest / 300) for least, most in bars.values()]
        axes.barh(at, wide, thick * 0.8, left, color=COLOURS[i % 7], label=label)
        for y, (least, most) in zip(at, bars.values(), strict=True):
            axes.annotate(
                f"{least:.0f} - {most:.0f}",
                (most, y),
                (4, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
                annotation_clip=False,
            )
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(0, longest * 1.15)
    axes.set_xlabel(unit)
    axes.legend(fontsize=8, loc="upper right")
    return _svg(figure)


def lines(
    title: str,
    x: Sequence[float],
    series: Mapping[str, Sequence[float]],
    *,
    x_label: str,
    y_label: str,
    log: bool = False,
) -> str:
    """One line for each name, over the same x values."""
    figure, axes = _figure(title)
    for i, (name, values) in enumerate(series.items()):
        axes.plot(x, values, "o" + _LINES[i % 4], color=COLOURS[i % 7], label=name, markersize=4)
    if log:
        axes.set_xscale("log")
        axes.set_yscale("log")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(visible=True, linewidth=0.3)
    axes.legend(fontsize=8)
    return _svg(figure)


def points(
    title: str,
    series: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    *,
    x_label: str,
    y_label: str,
    shaded: tuple[float, float] | None = None,
) -> str:
    """Points over time, with one time range shaded."""
    figure, axes = _figure(title)
    if shaded:
        axes.axvspan(*shaded, color="#dddddd", label="broker unreachable")
    for i, (name, (x, y)) in enumerate(series.items()):
        every = max(1, len(x) // 300)
        axes.plot(x[::every], y[::every], ".", color=COLOURS[i % 7], label=name, markersize=3)
    axes.set_yscale("symlog", linthresh=1)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(visible=True, linewidth=0.3)
    axes.legend(fontsize=8)
    return _svg(figure)


def _figure(title: str, height: float = 3.4) -> tuple[Figure, mpl.axes.Axes]:
    # No pyplot: it has global state and needs a display.
    figure = Figure(figsize=(6.8, height), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title, fontsize=10, loc="left")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(labelsize=8)
    return figure, axes


def _svg(figure: Figure) -> str:
    out = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "iort", "font.family": "sans-serif"}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None}, facecolor="white")
    text = out.getvalue()
    return text[text.index("<svg") :]
