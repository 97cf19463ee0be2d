"""Figures: lines with confidence bands or single runs, bars and points.

All look alike, with the same colour for the same policy everywhere.
matplotlib (the extra `sim`) is imported when a figure is drawn, never before, and without its global state.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rass_mav.errors import ConfigError, RassError, installing, os_errors_as
from rass_mav.lab.experiment.statistics import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Style:
    """A policy's drawing style: colour-blind people can distinguish the colours of Okabe and Ito."""

    label: str
    color: str
    marker: str


#: Inches; with more bars they become narrower.
WIDEST = 12.0

POLICIES: dict[str, Style] = {
    "rass": Style("RASS", "#0072B2", "o"),
    "hop-count": Style("hop count", "#D55E00", "s"),
    "stigmergy": Style("virtual stigmergy", "#009E73", "^"),
    "rass-literal": Style("RASS as printed (α = 10 on hops)", "#CC79A7", "D"),
    "survival": Style("survival", "#E69F00", "P"),
}
#: A horizontal line that is not a policy.
LEVEL = Style("", "#555555", "")
#: What a share can be; intervals are cut there.
SHARE = (0.0, 1.0)
#: What most other quantities can be.
POSITIVE = (0.0, math.inf)
#: For what is not a policy.
OTHERS = ("#56B4E9", "#E69F00", "#000000", "#009E73", "#D55E00", "#CC79A7")


def policy_style(policy: str) -> Style:
    """The style of a policy; a new policy is black."""
    return POLICIES.get(policy, Style(policy, "#000000", "x"))


@dataclass(frozen=True)
class Curve:
    """A line."""

    label: str
    """In the legend; empty: not in it."""
    x: Sequence[float]
    y: Sequence[float]
    """NaN leaves a gap."""
    color: str
    marker: str = ""
    band: Sequence[tuple[float, float]] | None = None
    """Confidence intervals, from where to where; NaN: none there."""
    singles: Sequence[Sequence[float]] = ()
    """The runs of which the line is the mean, where they are too few for a band: thin lines."""
    line: str = "-"
    """- for ours, -- for the authors'."""


@dataclass(frozen=True)
class Panel:
    """A pair of axes."""

    title: str
    x_label: str
    y_label: str
    """With the unit."""
    curves: Sequence[Curve]
    y_range: tuple[float, float] | None = None
    x_range: tuple[float, float] | None = None
    bounds: tuple[float, float] = POSITIVE
    """What y can be: bands are cut there."""


@dataclass(frozen=True)
class Bars:
    """Bars of one colour, one in each group."""

    label: str
    color: str
    groups: Sequence[Estimate | None]
    """With an error bar, or with a dot a run where they are too few for it; None: no bar."""
    hatch: str = ""


@dataclass(frozen=True)
class Point:
    """A point with error bars, or with a dot a run where they are too few for them."""

    style: Style
    """Its label is not shown."""
    x: Estimate
    y: Estimate
    """Of the same runs."""


@dataclass(frozen=True)
class Scatter:
    """A pair of axes with points."""

    title: str
    x_label: str
    y_label: str
    """With the unit."""
    points: Sequence[Point]
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    """A point outside the ranges is drawn at their edge, with its place in brackets."""
    bounds: tuple[float, float]
    """What y can be: error bars are cut there. x can be anything from 0 on."""
    level: float | None = None
    """A horizontal line at this y."""


def around(points: Sequence[Point]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Ranges of x and of y, a share, that show all these points."""
    widest = max(point.x.reach[1] for point in points)
    lowest = min(point.y.reach[0] for point in points)
    return (0.0, 1.08 * widest or 1.0), (max(0.0, math.floor(10 * lowest) / 10), 1.01)


def need_matplotlib() -> None:
    """Raises `ConfigError` if figures cannot be drawn: before hours of runs, not after."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError(f"figures need matplotlib: {installing('sim')}")


def draw(
    path: Path, panels: Sequence[Panel], *, columns: int = 1, legend_columns: int | None = None, note: str = ""
) -> Path:
    """Write panels, row by row, as PNG. `note`: small print below. The first panel's legend is above all.

    Panels of the same quantities in one row have the same scale.
    """
    rows = -(-len(panels) // columns)
    figure = _figure((6.4 * columns, 4.0 * rows + 0.9))
    grid = figure.subplots(rows, columns, squeeze=False)
    for index, panel in enumerate(panels):
        _draw_panel(grid[index // columns][index % columns], panel)
    for row in range(rows):
        here = panels[row * columns : (row + 1) * columns]
        for axis in ("x", "y"):
            if len({getattr(panel, f"{axis}_label") for panel in here}) == 1:
                _share_scale(grid[row][: len(here)], axis)
    for index in range(len(panels), rows * columns):
        grid[index // columns][index % columns].set_visible(False)
    _legend(figure, grid[0][0], legend_columns or 3 * columns)
    return _write(figure, path, note)


def _share_scale(row: Sequence[Axes], axis: Literal["x", "y"]) -> None:
    limits = [axes.get_xlim() if axis == "x" else axes.get_ylim() for axes in row]
    widest = min(low for low, _ in limits), max(high for _, high in limits)
    for axes in row:
        axes.set(**{f"{axis}lim": widest})


def draw_bars(
    path: Path,
    title: str,
    y_label: str,
    groups: Sequence[str],
    series: Sequence[Bars],
    *,
    bounds: tuple[float, float] = POSITIVE,
    note: str = "",
) -> Path:
    """Write groups of bars as PNG. `bounds`: what a height can be; error bars are cut there."""
    wanted = max(6.4, 1.3 + 0.55 * len(groups) * len(series))
    figure = _figure((min(wanted, WIDEST), 4.9))
    axes = figure.subplots()
    width = 0.8 / len(series)
    for index, bars in enumerate(series):
        at = [group + (index - (len(series) - 1) / 2) * width for group in range(len(groups))]
        heights = [0.0 if e is None else e.mean for e in bars.groups]
        axes.bar(
            at, heights, width * 0.92, label=bars.label, color=bars.color, hatch=bars.hatch, edgecolor="white",
            yerr=[list(side) for side in zip(*(_sides(e, bounds) for e in bars.groups), strict=True)],
            capsize=3, error_kw={"elinewidth": 1},
        )  # fmt: skip
        dots = [(x, value) for x, e in zip(at, bars.groups, strict=True) for value in (e.singles if e else ())]
        if dots:
            axes.plot(*zip(*dots, strict=True), "o", color="black", markersize=3, markeredgecolor="white", zorder=4)
    axes.set_xticks(range(len(groups)), groups)
    if wanted > WIDEST:
        axes.tick_params("x", labelrotation=30)
    axes.set_title(title, fontsize=11)
    axes.set_ylabel(y_label)
    axes.set_ylim(bottom=0)
    axes.margins(y=0.25)
    axes.grid(axis="y", alpha=0.3, linewidth=0.6)
    axes.set_axisbelow(True)
    _legend(figure, axes, 3)
    return _write(figure, path, note)


def draw_scatter(path: Path, panels: Sequence[Scatter], keys: Sequence[Style], *, note: str = "") -> Path:
    """Write panels side by side as PNG.

    `keys`: the legend, beside markers with "-" for a colour alone, and "" for the line at `level`.
    """
    figure = _figure((6.2 * len(panels) + 2.9, 5.2))
    row = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(row, panels, strict=True):
        _draw_points(axes, panel)
    for key in keys:
        line = {"": "--", "-": "-"}.get(key.marker, "none")
        row[0].plot(
            [], [], color=key.color, label=key.label, linestyle=line, linewidth=4 if line == "-" else 1.2,
            marker=key.marker if line == "none" else "none", markersize=7,
        )  # fmt: skip
    figure.legend(*row[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8, frameon=False)
    return _write(figure, path, note)


def _draw_points(axes: Axes, panel: Scatter) -> None:
    (left, right), (low, high) = panel.x_range, panel.y_range
    if panel.level is not None:
        axes.axhline(panel.level, color=LEVEL.color, linestyle="--", linewidth=1.2, zorder=1)
    # Points that coincide stay visible: later markers are smaller.
    markers = list(dict.fromkeys(point.style.marker for point in panel.points))
    for point in panel.points:
        x, y = min(max(point.x.mean, left), right), min(max(point.y.mean, low), high)
        outside = (x, y) != (point.x.mean, point.y.mean)
        color = point.style.color
        size = max(5.0, 10.5 - 1.5 * markers.index(point.style.marker))
        sides = (
            None
            if outside
            else [[[side] for side in _sides(e, b)] for e, b in ((point.x, POSITIVE), (point.y, panel.bounds))]
        )
        axes.errorbar(
            x, y, sides and sides[1], sides and sides[0], point.style.marker, color=color, elinewidth=1, capsize=2,
            markersize=size, markeredgecolor="white", markeredgewidth=0.7, zorder=3, clip_on=not outside,
        )  # fmt: skip
        if outside:
            axes.annotate(
                f"({point.x.mean:.3g}, {point.y.mean:.2f})", (x, y), (-7 if x == right else 7, 6),
                textcoords="offset points", ha="right" if x == right else "left", fontsize=8, color=color,
            )  # fmt: skip
        else:
            axes.plot(point.x.singles, point.y.singles, "o", color=color, markersize=3, alpha=0.7, zorder=2)
    _label(axes, panel)
    axes.set(xlim=(left, right), ylim=(low, high))


def _sides(value: Estimate | None, bounds: tuple[float, float]) -> tuple[float, float]:
    """How far an error bar goes down and up; no farther than values can be."""
    if value is None or value.drawn is None:
        return 0.0, 0.0
    low, high = max(value.drawn[0], bounds[0]), min(value.drawn[1], bounds[1])
    return max(0.0, value.mean - low), max(0.0, high - value.mean)


def _figure(size: tuple[float, float]) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def _draw_panel(axes: Axes, panel: Panel) -> None:
    from matplotlib.ticker import MaxNLocator

    ours = [curve for curve in panel.curves if curve.line == "-"]
    for curve in panel.curves:
        # Lines that coincide stay visible: each is thinner than the one below it, and its markers are elsewhere, or
        # where that is impossible, smaller and edged. The authors' lines are above ours and dashed.
        order = ours.index(curve) if curve in ours else len(ours)
        spacing = max(1, len(curve.x) // 9)
        axes.plot(
            curve.x, curve.y, curve.line, color=curve.color, label=curve.label or None, zorder=2 + 0.1 * order,
            linewidth=1.5 + 1.1 * max(0, min(len(ours), 3) - 1 - order) if curve in ours else 1.3,
            marker=curve.marker or None, markersize=4.5 + 1.6 * max(0, len(ours) - 1 - order),
            markeredgecolor="white", markeredgewidth=0.6,
            markevery=(order * spacing // max(1, len(ours)), spacing),
        )  # fmt: skip
        if curve.band is not None:
            least, most = panel.bounds
            # In this order of arguments NaN stays NaN.
            low = [max(low, least) for low, _ in curve.band]
            high = [min(high, most) for _, high in curve.band]
            axes.fill_between(curve.x, low, high, color=curve.color, alpha=0.18, linewidth=0)
        for single in curve.singles:
            axes.plot(curve.x, single, color=curve.color, linewidth=0.7, alpha=0.55, zorder=1.5)
    _label(axes, panel)
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)
    elif all(not y < 0 for curve in panel.curves for y in curve.y if math.isfinite(y)):
        axes.set_ylim(bottom=0)
    if all(isinstance(x, int) for curve in panel.curves for x in curve.x):
        axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10]))
    if all(isinstance(y, int) for curve in panel.curves for y in curve.y):
        axes.yaxis.set_major_locator(MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10]))
    if panel.x_range is not None:
        axes.set_xlim(*panel.x_range)


def _label(axes: Axes, panel: Panel | Scatter) -> None:
    axes.set_title(panel.title, fontsize=11)
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    axes.grid(alpha=0.3, linewidth=0.6)


def _legend(figure: Figure, axes: Axes, columns: int) -> None:
    """Above the axes, where it covers no line."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        # Filled row by row: a policy's own line, then the others.
        columns = min(columns, len(handles))
        order = [i for column in range(columns) for i in range(column, len(handles), columns)]
        figure.legend(
            [handles[i] for i in order], [labels[i] for i in order], loc="outside upper center", ncols=columns,
            fontsize=8, frameon=False,
        )  # fmt: skip


def _write(figure: Figure, path: Path, note: str) -> Path:
    if note:
        figure.supxlabel(note, fontsize=7.5, color="#444444")
    with os_errors_as(RassError, path):
        figure.savefig(path, dpi=150, format="png")
    return path
