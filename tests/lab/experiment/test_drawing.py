"""What figures show, asked of matplotlib's own objects; the pixels are for people."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rass_mav.lab.experiment import figures
from rass_mav.lab.experiment.curves import mean_curve
from rass_mav.lab.experiment.figures import SHARE, Bars, Curve, Panel, Point, Scatter, Style
from rass_mav.lab.experiment.statistics import Share, estimate, estimate_share
from tests.some import some

X = [0, 10, 20]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were written."""
    written: list[Figure] = []
    save = Figure.savefig

    def savefig(figure: Figure, path: Path, **options: Any) -> None:
        written.append(figure)
        save(figure, path, **options)

    monkeypatch.setattr(Figure, "savefig", savefig)
    return written


def panel(curves: Sequence[Curve], **keys: tuple[float, float]) -> Panel:
    return Panel("title", "step", "reliability", curves, **keys)


def runs(count: int) -> Curve:
    return mean_curve(Style("RASS", "blue", "o"), X, [[1.0, 0.9 + 0.02 * run, 0.1 * run] for run in range(count)])


def bands(axes: Axes) -> list[PolyCollection]:
    return [part for part in axes.collections if isinstance(part, PolyCollection)]


@pytest.mark.parametrize(("count", "lines", "shaded"), [(1, 1, 0), (4, 5, 0), (5, 1, 1)])
def test_few_runs_are_shown_one_by_one_and_many_by_a_band(
    count: int, lines: int, shaded: int, tmp_path: Path, drawn: list[Figure]
) -> None:
    figures.draw(tmp_path / "a.png", [panel([runs(count)], bounds=SHARE)])
    [axes] = drawn[0].axes
    assert (len(axes.lines), len(bands(axes))) == (lines, shaded)


def test_a_band_ends_where_shares_end_and_has_a_gap_where_there_is_none(tmp_path: Path, drawn: list[Figure]) -> None:
    ys = [0.95, 0.95, math.nan, 0.05, 0.05]
    curve = Curve("RASS", [0, 1, 2, 3, 4], ys, "blue", band=[(y - 0.2, y + 0.2) for y in ys])
    figures.draw(tmp_path / "a.png", [panel([curve], bounds=SHARE)])
    [band] = bands(drawn[0].axes[0])
    before, after = (np.asarray(path.vertices)[:, 1] for path in band.get_paths())
    assert (min(before), max(before)) == (0.75, 1.0)
    assert (min(after), max(after)) == (0.0, 0.25)


def test_a_band_of_shares_is_theirs_and_reaches_below_where_nothing_was_lost(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    rows = [[Share(10, 10), Share(10 - run, 10)] for run in range(5)]
    figures.draw(tmp_path / "a.png", [panel([mean_curve(Style("RASS", "blue", "o"), [0, 1], rows)], bounds=SHARE)])
    [axes] = drawn[0].axes
    [band] = bands(axes)
    [lowest] = {float(y) for x, y in np.asarray(band.get_paths()[0].vertices) if x == 0 and y < 1}
    sure = some(estimate_share([Share(10, 10)] * 5).interval)
    assert lowest == pytest.approx(sure[0])
    figures.draw(tmp_path / "a.png", [panel([mean_curve(Style("RASS", "blue", "o"), [0, 1], rows[:2])], bounds=SHARE)])
    assert [heights(line) for line in drawn[1].axes[0].lines[1:]] == [[1.0, 1.0], [1.0, 0.9]]


def test_panels_of_a_row_have_one_scale(tmp_path: Path, drawn: list[Figure]) -> None:
    def line(top: float, last: int) -> Panel:
        return panel([Curve("RASS", [0, last], [0.0, top], "blue")], y_range=(0, top))

    figures.draw(tmp_path / "a.png", [line(1, 10), line(7, 30), line(2, 5)], columns=2)
    first, second, third, unused = drawn[0].axes
    assert first.get_ylim() == second.get_ylim() == (0, 7)
    assert first.get_xlim() == second.get_xlim()
    assert third.get_ylim() == (0, 2)
    assert not unused.get_visible()


def test_curves_that_coincide_have_their_markers_elsewhere_or_of_another_size(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    for length in (3, 100):
        curves = [Curve(name, list(range(length)), [1.0] * length, "blue", name) for name in "os^"]
        figures.draw(tmp_path / "a.png", [panel(curves)])
    for figure, apart in zip(drawn, (False, True), strict=True):
        lines = figure.axes[0].lines
        assert len({line.get_marker() for line in lines}) == 3
        assert len({line.get_markersize() for line in lines}) == 3
        assert len({line.get_linewidth() for line in lines}) == 3
        assert (len({str(line.get_markevery()) for line in lines}) == 3) is apart


def heights(line: Line2D) -> list[float]:
    return [float(y) for y in np.asarray(line.get_ydata())]


def error_bars(axes: Axes) -> list[tuple[float, float]]:
    """From where to where those go that have a length."""
    ends = [
        (segment[0][1], segment[1][1])
        for part in axes.collections
        if isinstance(part, LineCollection)
        for segment in part.get_segments()
    ]
    return [(low, high) for low, high in ends if low != high]


def test_bars_have_error_bars_within_bounds_or_dots(tmp_path: Path, drawn: list[Figure]) -> None:
    many, few = estimate([0.0, 1.0, 1.0, 1.0, 1.0]), estimate([0.2, 0.4])
    series = [Bars("RASS", "blue", [many, few, None])]
    figures.draw_bars(tmp_path / "a.png", "title", "share", ["a", "b", "c"], series, bounds=SHARE)
    [axes] = drawn[0].axes
    [(low, high)] = error_bars(axes)
    assert low == pytest.approx(0.8 - 0.5553, abs=1e-3)
    assert high == 1.0
    [dots] = [line for line in axes.lines if line.get_marker() == "o"]
    assert heights(dots) == [0.2, 0.4]


def test_points_have_error_bars_within_bounds_or_dots(tmp_path: Path, drawn: list[Figure]) -> None:
    sure, few = estimate([1.0, 2.0, 3.0, 4.0, 5.0]), estimate([0.4, 0.5])
    share = some(estimate([0.9, 1.0, 1.0, 1.0, 1.0]))
    assert few is not None
    style = Style("RASS", "blue", "s")
    points = [Point(style, some(sure), share), Point(style, few, few)]
    scatter = Scatter("title", "sent", "reliability", points, (0.0, 9.0), (0.0, 1.01), SHARE)
    figures.draw_scatter(tmp_path / "a.png", [scatter], [])
    [axes] = drawn[0].axes
    [(_, high)] = error_bars(axes)
    assert high == 1.0
    assert [heights(line) for line in axes.lines if line.get_marker() == "o" and heights(line)] == [[0.4, 0.5]]
