"""Plots as SVG: axes with round ticks, series of marks and lines in them, and how they are drawn.

Own code instead of a plotting library, because the report needs what matplotlib's SVG does not give: text stays text,
every mark carries its numbers as a tooltip, colours follow the reader's light or dark setting through one style sheet
that a page states once, and a file of a few kilobytes changes in a diff where a number changed. Series differ by shape
as well as by colour.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
EDGE = 0.06
"""Room between the outermost marks and the frame, as a share of the axis."""


class Point(NamedTuple):
    """One mark: its place, and what the tooltip says."""

    x: float
    y: float
    note: str = ""
    faded: bool = False


@dataclass(frozen=True)
class Series:
    """Marks of one colour and shape; `line` joins some points, `hollow` marks are figures from elsewhere."""

    name: str
    points: tuple[Point, ...]
    line: tuple[tuple[float, float], ...] = ()
    color: int = 0
    hollow: bool = False


@dataclass(frozen=True)
class Axis:
    """A range of values with a label that names the unit."""

    label: str
    low: float
    high: float
    log: bool = False

    @classmethod
    def around(cls, label: str, values: Iterable[float], log: bool = False) -> Axis:
        """The range of `values` with some room at both ends; a decade around a single one."""
        known = [value for value in values if math.isfinite(value) and (value > 0 or not log)] or [1.0]
        low, high = (math.log10(min(known)), math.log10(max(known))) if log else (min(known), max(known))
        if high - low < 1e-9 * max(abs(high), 1e-12) or (log and high - low < 0.3):
            room = 0.5 if log else max(0.1 * abs(high), 1e-6)
        else:
            room = EDGE * (high - low)
        ends = (low - room, high + room)
        return cls(label, *((10 ** ends[0], 10 ** ends[1]) if log else ends), log)

    def place(self, value: float) -> float:
        """0 at `low`, 1 at `high`."""
        if self.log:
            return math.log(max(value, 1e-300) / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self, most: int = 7) -> list[tuple[float, str]]:
        """Round values within the range, with their text."""
        values = self._decades(most) if self.log else self._steps(most)
        return [(value, number(value)) for value in values if self.low <= value <= self.high]

    def _decades(self, most: int) -> list[float]:
        first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
        if last - first >= 2:
            return [10.0**power for power in range(first, last + 1, math.ceil((last - first + 1) / most))]
        factors = (1, 2, 5) if self.high / self.low > 3 else (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)
        return [factor * 10.0**power for power in range(first - 1, last + 1) for factor in factors]

    def _steps(self, most: int) -> list[float]:
        raw = (self.high - self.low) / most
        unit = 10 ** math.floor(math.log10(raw))
        step = next(factor * unit for factor in (1, 2, 5, 10) if factor * unit >= raw)
        return [step * i for i in range(math.ceil(self.low / step), math.floor(self.high / step) + 1)]


@dataclass(frozen=True)
class Plot:
    """Axes with series in them."""

    title: str
    x: Axis
    y: Axis
    series: tuple[Series, ...]


def number(value: float) -> str:
    """A short text: plain where that is short, powers of ten otherwise."""
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return f"{value:.6g}"
    power = math.floor(math.log10(abs(value)) + 1e-9)
    mantissa = value / 10.0**power
    front = "" if abs(mantissa - 1) < 1e-6 else f"{mantissa:.3g}·"
    return f"{front}10{str(power).translate(SUPERSCRIPTS)}"


LIGHT = ("#2a78d6", "#eb6834", "#149a69", "#b07c00", "#d0589a", "#4a3aa7", "#e34948", "#008300")
DARK = ("#5598e7", "#e0713f", "#2db584", "#d09a1d", "#d55181", "#9085e9", "#e66767", "#4aa84a")
SHAPES = ("circle", "square", "diamond", "triangle", "cross", "wedge")

MARGIN_LEFT, MARGIN_RIGHT, MARGIN_TOP, MARGIN_BOTTOM = 76, 18, 34, 46
LETTER = 6.4
"""Mean width of a letter at 12 px, px."""


def style() -> str:
    """The rules that all plots share; a page that shows several states them once."""

    def rules(surface: str, ink: str, soft: str, grid: str, colors: Sequence[str]) -> str:
        series = "".join(f".s{i}{{fill:{c};stroke:{c}}}" for i, c in enumerate(colors))
        return f".surface{{fill:{surface}}}.ink{{fill:{ink}}}.soft{{fill:{soft}}}.grid{{stroke:{grid}}}{series}"

    fixed = (
        "svg.plot text{font:12px system-ui,sans-serif}svg.plot .title{font-weight:600;font-size:13px}"
        ".front{fill:none;stroke-width:2}.hollow{fill:none;stroke-width:1.8}"
        ".faded{opacity:.4}.edge{stroke:none}"
    )
    light = rules("#fcfcfb", "#1b1b1a", "#5c5b57", "#e4e3df", LIGHT)
    dark = rules("#1a1a19", "#f0efec", "#b3b1aa", "#383835", DARK)
    # Fill of a hollow mark and of a line must win over the series' colour whatever the order of the rules.
    late = "svg.plot .front,svg.plot .hollow{fill:none}"
    return f"{fixed}{light}@media(prefers-color-scheme:dark){{{dark}}}{late}"


def figure(plots: Sequence[Plot], description: str, columns: int = 1, size: tuple[int, int] = (720, 380)) -> str:
    """All plots on a grid under one legend, as one SVG; `description` is what a screen reader says.

    `size` is that of one plot, px. Plots without a mark are left out.
    """
    plots = [plot for plot in plots if any(series.points for series in plot.series)]
    if not plots:
        return document(text(size[0] / 2, 40, "nothing was measured", "soft", "middle"), size[0], 70, description)
    columns = min(columns, len(plots))
    legend, top = _legend(plots, columns * size[0])
    parts = [legend]
    for first in range(0, len(plots), columns):
        row = plots[first : first + columns]
        parts += [_plot(plot, place * size[0], top, size) for place, plot in enumerate(row)]
        top += size[1]
    return document("".join(parts), columns * size[0], top, description)


def document(body: str, width: float, height: float, description: str) -> str:
    """A whole SVG with its rules."""
    return (
        f'<svg class="plot" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}" role="img"><title>{escape(description)}</title>'
        f'<style>{style()}</style><rect class="surface" width="100%" height="100%"/>{body}</svg>\n'
    )


def text(x: float, y: float, words: str, classes: str = "ink", anchor: str = "start", turn: bool = False) -> str:
    """One line of text; `anchor` is start, middle or end."""
    turned = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turn else ""
    return f'<text class="{classes}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{turned}>{escape(words)}</text>'


def _legend(plots: Sequence[Plot], width: float) -> tuple[str, float]:
    """Each series of the plots once, in as many rows as that needs, and their height; none for a single series."""
    known: dict[tuple[str, int, bool], Series] = {}
    for series in (series for plot in plots for series in plot.series if series.name):
        known.setdefault((series.name, series.color, series.hollow), series)
    if len(known) < 2:
        return "", 6
    parts, x, y = [], 16.0, 18.0
    for series in known.values():
        wide = 36 + 1.1 * LETTER * len(series.name)
        if x + wide > width - 10 and x > 16:
            x, y = 16.0, y + 20
        if series.points or not series.line:
            sign = _mark(x + 6, y - 4, series.color, series.hollow)
        else:
            sign = f'<path class="{_color(series.color)} front" d="M{x - 1:.1f} {y - 4:.1f}h16"{_dashes(series)}/>'
        parts += [sign, text(x + 18, y, series.name)]
        x += wide
    return "".join(parts), y + 10


def _color(index: int) -> str:
    return f"s{index % len(LIGHT)}"


def _dashes(series: Series) -> str:
    return ' stroke-dasharray="5 4"' if series.hollow else ""


def _plot(plot: Plot, left: float, top: float, size: tuple[int, int]) -> str:
    x0, x1 = left + MARGIN_LEFT, left + size[0] - MARGIN_RIGHT
    y0, y1 = top + size[1] - MARGIN_BOTTOM, top + MARGIN_TOP
    at = lambda x, y: (x0 + (x1 - x0) * plot.x.place(x), y0 + (y1 - y0) * plot.y.place(y))  # noqa: E731
    parts = [text(x0, top + 20, plot.title, "ink title")]
    for value, words in plot.x.ticks(max(3, int((x1 - x0) / 85))):
        x = at(value, plot.y.low)[0]
        parts += [f'<path class="grid" d="M{x:.1f} {y0:.1f}V{y1:.1f}"/>', text(x, y0 + 16, words, "soft", "middle")]
    for value, words in plot.y.ticks(max(3, int((y0 - y1) / 45))):
        y = at(plot.x.low, value)[1]
        parts += [f'<path class="grid" d="M{x0:.1f} {y:.1f}H{x1:.1f}"/>', text(x0 - 6, y + 4, words, "soft", "end")]
    parts.append(text((x0 + x1) / 2, y0 + 36, plot.x.label, "soft", "middle"))
    parts.append(text(left + 14, (y0 + y1) / 2, plot.y.label, "soft", "middle", turn=True))
    for series in plot.series:
        if len(series.line) > 1:
            path = "L".join("{:.1f} {:.1f}".format(*at(*point)) for point in series.line)
            parts.append(f'<path class="{_color(series.color)} front" d="M{path}"{_dashes(series)}/>')
        parts += [_mark(*at(p.x, p.y), series.color, series.hollow, p.note, p.faded) for p in series.points]
    return "".join(parts)


def _mark(x: float, y: float, color: int, hollow: bool, note: str = "", faded: bool = False) -> str:
    """A mark of about 9 px, the shape that goes with its colour, with a tooltip."""
    r, shape = 4.5, SHAPES[color % len(SHAPES)]
    classes = f"{_color(color)} {'hollow' if hollow else 'edge'}{' faded' if faded else ''}"
    tip = f"<title>{escape(note)}</title>" if note else ""
    if shape == "circle":
        return f'<circle class="{classes}" cx="{x:.1f}" cy="{y:.1f}" r="{r}">{tip}</circle>'
    outlines = {
        "square": f"M{x - 4:.1f} {y - 4:.1f}h8v8h-8z",
        "diamond": f"M{x:.1f} {y - 5.5:.1f}l5.5 5.5l-5.5 5.5l-5.5 -5.5z",
        "triangle": f"M{x:.1f} {y - 5:.1f}l5 9h-10z",
        "wedge": f"M{x:.1f} {y + 5:.1f}l5 -9h-10z",
        "cross": f"M{x - 1.5:.1f} {y - 5:.1f}h3v3.5h3.5v3h-3.5v3.5h-3v-3.5h-3.5v-3h3.5z",
    }
    return f'<path class="{classes}" d="{outlines[shape]}">{tip}</path>'
