"""Figures: lines with confidence bands, and bars. One look for all, the same colour for the same policy everywhere.

matplotlib (the extra `sim`) is imported when a figure is drawn, never before, and without its global state.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rass_mav.errors import ConfigError, RassError, installing, os_errors_as

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Style:
    """How a policy looks: the colours of Okabe and Ito can be told apart by colour-blind people."""

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
#: For curves that are not policies.
OTHERS = ("#56B4E9", "#E69F00", "#000000")


def policy_style(policy: str) -> Style:
    """The style of a policy; a new policy is black."""
    return POLICIES.get(policy, Style(policy, "#000000", "x"))


@dataclass(frozen=True)
class Curve:
    """A line."""

    label: str
    """In the legend; empty: not there."""
    x: Sequence[float]
    y: Sequence[float]
    """NaN leaves a gap."""
    color: str
    marker: str = ""
    half: Sequence[float] | None = None
    """Half widths of confidence intervals: a band around the line; NaN: none there."""
    line: str = "-"
    """- ours, -- the authors'."""


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


@dataclass(frozen=True)
class Bars:
    """Bars of one colour, one in each group."""

    label: str
    color: str
    heights: Sequence[float]
    halves: Sequence[float]
    """Half widths of confidence intervals; 0: none."""
    hatch: str = ""


@dataclass(frozen=True)
class Point:
    """A point with error bars."""

    style: Style
    """Its label is not shown."""
    x: float
    y: float
    x_half: float = 0.0
    """Half width of its confidence interval; 0: none."""
    y_half: float = 0.0


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
    """A point outside of the ranges is drawn at their edge, with its place in brackets."""
    level: float | None = None
    """A horizontal line at this y."""


def need_matplotlib() -> None:
    """Raises `ConfigError` if figures cannot be drawn; before hours of runs, not after."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError(f"figures need matplotlib: {installing('sim')} (make install has it)")


def draw(
    path: Path, panels: Sequence[Panel], *, columns: int = 1, legend_columns: int | None = None, note: str = ""
) -> Path:
    """Write panels, row by row, as PNG. `note`: small print below. The first panel's legend stands above all."""
    rows = -(-len(panels) // columns)
    figure = _figure((6.4 * columns, 4.0 * rows + 0.9))
    grid = figure.subplots(rows, columns, squeeze=False)
    for index, panel in enumerate(panels):
        _draw_panel(grid[index // columns][index % columns], panel)
    for index in range(len(panels), rows * columns):
        grid[index // columns][index % columns].set_visible(False)
    _legend(figure, grid[0][0], legend_columns or 3 * columns)
    return _write(figure, path, note)


def draw_bars(
    path: Path, title: str, y_label: str, groups: Sequence[str], series: Sequence[Bars], *, note: str = ""
) -> Path:
    """Write groups of bars with error bars as PNG."""
    wanted = max(6.4, 1.3 + 0.55 * len(groups) * len(series))
    figure = _figure((min(wanted, WIDEST), 4.9))
    axes = figure.subplots()
    width = 0.8 / len(series)
    for index, bars in enumerate(series):
        at = [group + (index - (len(series) - 1) / 2) * width for group in range(len(groups))]
        axes.bar(
            at, bars.heights, width * 0.92, label=bars.label, color=bars.color, hatch=bars.hatch, edgecolor="white",
            yerr=list(bars.halves), capsize=3, error_kw={"elinewidth": 1},
        )  # fmt: skip
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
        x, y = min(max(point.x, left), right), min(max(point.y, low), high)
        outside = (x, y) != (point.x, point.y)
        color = point.style.color
        size = max(5.0, 10.5 - 1.5 * markers.index(point.style.marker))
        axes.errorbar(
            x, y, 0.0 if outside else point.y_half, 0.0 if outside else point.x_half, point.style.marker, color=color,
            elinewidth=1, capsize=2, markersize=size, markeredgecolor="white", markeredgewidth=0.7, zorder=3,
            clip_on=not outside,
        )  # fmt: skip
        if outside:
            axes.annotate(
                f"({point.x:.3g}, {point.y:.2f})", (x, y), (-7 if x == right else 7, 6), textcoords="offset points",
                ha="right" if x == right else "left", fontsize=8, color=color,
            )  # fmt: skip
    _label(axes, panel)
    axes.set(xlim=(left, right), ylim=(low, high))


def _figure(size: tuple[float, float]) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def _draw_panel(axes: Axes, panel: Panel) -> None:
    from matplotlib.ticker import MaxNLocator

    ours = [curve for curve in panel.curves if curve.line == "-"]
    for curve in panel.curves:
        # Lines that coincide stay visible: each is thinner than the one below it, its markers stand elsewhere. The
        # authors' lines lie above ours and are dashed.
        order = ours.index(curve) if curve in ours else len(ours)
        spacing = max(1, len(curve.x) // 9)
        axes.plot(
            curve.x, curve.y, curve.line, color=curve.color, label=curve.label or None, zorder=2 + 0.1 * order,
            linewidth=1.5 + 1.1 * max(0, min(len(ours), 3) - 1 - order) if curve in ours else 1.3,
            marker=curve.marker or None, markersize=4 + 1.3 * max(0, len(ours) - 1 - order),
            markevery=(order * spacing // max(1, len(ours)), spacing),
        )  # fmt: skip
        if curve.half is not None:
            low = [y - h for y, h in zip(curve.y, curve.half, strict=True)]
            high = [y + h for y, h in zip(curve.y, curve.half, strict=True)]
            axes.fill_between(curve.x, low, high, color=curve.color, alpha=0.18, linewidth=0)
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
