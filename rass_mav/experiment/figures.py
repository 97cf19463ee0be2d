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

from rass_mav.core.errors import ConfigError, RassError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Style:
    """How a policy looks: the colours of Okabe and Ito can be told apart by colour-blind people."""

    label: str
    color: str
    marker: str


POLICIES: dict[str, Style] = {
    "rass": Style("RASS", "#0072B2", "o"),
    "hop-count": Style("hop count", "#D55E00", "s"),
    "stigmergy": Style("virtual stigmergy", "#009E73", "^"),
    "rass-literal": Style("RASS as printed (α = 10 on hops)", "#CC79A7", "D"),
}
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


def need_matplotlib() -> None:
    """Raises `ConfigError` if figures cannot be drawn; before hours of runs, not after."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError("figures need matplotlib: pip install 'rass-mav[sim]'")


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
    figure = _figure((max(6.4, 1.3 + 0.55 * len(groups) * len(series)), 4.9))
    axes = figure.subplots()
    width = 0.8 / len(series)
    for index, bars in enumerate(series):
        at = [group + (index - (len(series) - 1) / 2) * width for group in range(len(groups))]
        axes.bar(
            at, bars.heights, width * 0.92, label=bars.label, color=bars.color, hatch=bars.hatch, edgecolor="white",
            yerr=list(bars.halves), capsize=3, error_kw={"elinewidth": 1},
        )  # fmt: skip
    axes.set_xticks(range(len(groups)), groups)
    axes.set_title(title, fontsize=11)
    axes.set_ylabel(y_label)
    axes.set_ylim(bottom=0)
    axes.margins(y=0.25)
    axes.grid(axis="y", alpha=0.3, linewidth=0.6)
    axes.set_axisbelow(True)
    _legend(figure, axes, 3)
    return _write(figure, path, note)


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
    axes.set_title(panel.title, fontsize=11)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
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
    try:
        figure.savefig(path, dpi=150, format="png")
    except OSError as error:
        raise RassError(f"{path}: {(error.strerror or str(error)).lower()}") from None
    return path
