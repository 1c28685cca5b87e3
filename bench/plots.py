"""The report's pictures: small SVGs, legible in black on white and for colour-blind readers.

Each function returns a picture without a title, which `Section.plot` gives it."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

# Okabe and Ito's colours.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_LINES = ("-", "--", "-.", ":")
# A curve of thousands of points looks the same with a hundred.
_POINTS = 100
_HEIGHT = 3.4
Draw = Callable[[str], str]


def cdf(curves: Mapping[str, Sequence[float]]) -> Draw:
    """The share of values up to each value in ms, on a logarithmic axis."""

    def fill(axes: mpl.axes.Axes) -> None:
        for i, (name, values) in enumerate((name, values) for name, values in curves.items() if values):
            ordered = sorted(values)
            at = [round(k * (len(ordered) - 1) / (_POINTS - 1)) for k in range(_POINTS)]
            shares = [(k + 1) / len(ordered) for k in at]
            style: dict[str, Any] = {"color": COLOURS[i % 7], "label": name, "linewidth": 1.6}
            axes.plot([ordered[k] for k in at], shares, _LINES[i % 4], **style)
        axes.set(xscale="log", ylim=(0, 1.01))
        axes.grid(visible=True, which="both", linewidth=0.3)
        axes.legend(fontsize=8, loc="lower right")

    return _picture(fill, "ms", "share of messages")


def bars(values: Mapping[str, float], *, unit: str, log: bool = False) -> Draw:
    """One bar for each name, with its value at the end."""

    def fill(axes: mpl.axes.Axes) -> None:
        names = list(values)
        axes.barh(names, list(values.values()), color=[COLOURS[i % 7] for i in range(len(names))])
        axes.invert_yaxis()
        if log:
            axes.set_xscale("log")
        for i, value in enumerate(values.values()):
            axes.annotate(f" {value:,.3g}", (value, i), va="center", fontsize=8, annotation_clip=False)
        axes.margins(x=0.18)

    return _picture(fill, unit, height=0.42 * len(values) + 1.0)


def ranges(
    names: Sequence[str], series: Mapping[str, Mapping[str, tuple[float, float]]], *, unit: str
) -> Draw:
    """One row for each name, with a bar from least to most for each series that has the name."""
    thick = 0.8 / len(series)
    longest = max(most for bars in series.values() for _, most in bars.values())

    def fill(axes: mpl.axes.Axes) -> None:
        for i, (label, bars) in enumerate(series.items()):
            at = [names.index(name) + (i - (len(series) - 1) / 2) * thick for name in bars]
            left = [least for least, _ in bars.values()]
            # An empty range must be visible too.
            wide = [max(most - least, longest / 300) for least, most in bars.values()]
            axes.barh(at, wide, thick * 0.8, left, color=COLOURS[i % 7], label=label)
            text: dict[str, Any] = {
                "xytext": (4, 0),
                "textcoords": "offset points",
                "va": "center",
                "fontsize": 8,
            }
            for y, (least, most) in zip(at, bars.values(), strict=True):
                axes.annotate(f"{least:.0f} - {most:.0f}", (most, y), annotation_clip=False, **text)
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
        axes.set_xlim(0, longest * 1.15)
        axes.legend(fontsize=8, loc="upper right")

    return _picture(fill, unit, height=0.5 * len(names) + 1.0)


def grouped(series: Mapping[str, Mapping[str, float]], *, unit: str) -> Draw:
    """A group of bars for each name, with a bar for each series, the palest first."""
    names = list(next(iter(series.values())))
    thick = 0.8 / len(series)

    def fill(axes: mpl.axes.Axes) -> None:
        for i, (label, values) in enumerate(series.items()):
            at = [k + (i - (len(series) - 1) / 2) * thick for k in range(len(names))]
            shade: dict[str, Any] = {"color": COLOURS[0], "alpha": (i + 1) / len(series), "label": label}
            axes.barh(at, [values[name] for name in names], thick * 0.9, **shade)
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
        axes.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1, 1), ncols=len(series))

    return _picture(fill, unit, height=0.42 * len(names) + 1.0)


def lines(x: Sequence[float], series: Mapping[str, Sequence[float]], *, x_label: str, y_label: str) -> Draw:
    """One line for each name, over the same x values, on logarithmic axes."""

    def fill(axes: mpl.axes.Axes) -> None:
        for i, (name, values) in enumerate(series.items()):
            axes.plot(x, values, "o" + _LINES[i % 4], color=COLOURS[i % 7], label=name, markersize=4)
        axes.set(xscale="log", yscale="log")
        axes.grid(visible=True, linewidth=0.3)
        axes.legend(fontsize=8)

    return _picture(fill, x_label, y_label)


def over(x: Sequence[float], series: Mapping[str, Sequence[float]], *, x_label: str, y_label: str) -> Draw:
    """One line for each name, over the same x values, from 0 on."""

    def fill(axes: mpl.axes.Axes) -> None:
        for i, (name, values) in enumerate(series.items()):
            axes.plot(x, values, _LINES[i % 4], color=COLOURS[i % 7], label=name, linewidth=1.6)
        axes.set_ylim(bottom=0)
        axes.grid(visible=True, linewidth=0.3)
        axes.legend(fontsize=8)

    return _picture(fill, x_label, y_label)


def points(
    name: str, x: Sequence[float], y: Sequence[float], *, y_label: str, shaded: tuple[float, float]
) -> Draw:
    """Points over seconds, with the time without a broker shaded."""

    def fill(axes: mpl.axes.Axes) -> None:
        axes.axvspan(*shaded, color="#dddddd", label="broker unreachable")
        every = max(1, len(x) // 300)
        axes.plot(x[::every], y[::every], ".", color=COLOURS[0], label=name, markersize=3)
        axes.set_yscale("symlog", linthresh=1)
        axes.grid(visible=True, linewidth=0.3)
        axes.legend(fontsize=8)

    return _picture(fill, "s", y_label)


def _picture(
    fill: Callable[[mpl.axes.Axes], None], x_label: str, y_label: str = "", height: float = _HEIGHT
) -> Draw:
    """Return a function from the title to the SVG."""

    def draw(title: str) -> str:
        # No pyplot: it has global state and needs a display.
        figure = Figure(figsize=(6.8, height), layout="constrained")
        axes = figure.subplots()
        axes.set_title(title, fontsize=10, loc="left")
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        fill(axes)
        axes.set(xlabel=x_label, ylabel=y_label)
        out = io.StringIO()
        with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "iort", "font.family": "sans-serif"}):
            figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None}, facecolor="white")
        text = out.getvalue()
        return text[text.index("<svg") :]

    return draw
