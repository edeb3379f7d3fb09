"""Plots as SVG, the only plot engine of this package.

It is used instead of a plotting library because the report needs what matplotlib's SVG does not give: text stays text,
every mark carries its numbers as a tooltip, colours follow the reader's light or dark setting through one style sheet
that a page states once, and a file of a few kilobytes changes in a diff where a number changed. Series differ by shape
as well as by colour.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape

from d2_plugin.runs.report.plots import Plot, Series

LIGHT = ("#2a78d6", "#eb6834", "#149a69", "#b07c00", "#d0589a", "#4a3aa7", "#e34948", "#008300")
DARK = ("#5598e7", "#e0713f", "#2db584", "#d09a1d", "#d55181", "#9085e9", "#e66767", "#4aa84a")
SHAPES = ("circle", "square", "diamond", "triangle", "cross", "wedge")

MARGIN_LEFT, MARGIN_RIGHT, MARGIN_TOP, MARGIN_BOTTOM = 76, 18, 34, 46
LETTER = 6.4
"""Mean width of a letter at 12 px, px."""
LABELLED = 320
"""In plots narrower than this marks have tooltips but no labels, px."""
NAMED_ROW = 24
"""Height of one name on an axis that lists names, px."""


def style() -> str:
    """The rules that all plots share; a page that shows several states them once."""

    def rules(surface: str, ink: str, soft: str, grid: str, colors: Sequence[str]) -> str:
        series = "".join(f".s{i}{{fill:{c};stroke:{c}}}" for i, c in enumerate(colors))
        return f".surface{{fill:{surface}}}.ink{{fill:{ink}}}.soft{{fill:{soft}}}.grid{{stroke:{grid}}}{series}"

    fixed = (
        "svg.plot text{font:12px system-ui,sans-serif}svg.plot .title{font-weight:600;font-size:13px}"
        "svg.plot .small{font-size:10.5px}.front{fill:none;stroke-width:2}.hollow{fill:none;stroke-width:1.8}"
        ".faded{opacity:.4}.edge{stroke:none}"
    )
    light = rules("#fcfcfb", "#1b1b1a", "#5c5b57", "#e4e3df", LIGHT)
    dark = rules("#1a1a19", "#f0efec", "#b3b1aa", "#383835", DARK)
    # Fill of a hollow mark and of a line must win over the series' colour whatever the order of the rules.
    late = "svg.plot .front,svg.plot .hollow{fill:none}"
    return f"{fixed}{light}@media(prefers-color-scheme:dark){{{dark}}}{late}"


def figure(plots: Sequence[Plot], description: str, columns: int = 1, size: tuple[int, int] = (720, 380)) -> str:
    """All plots on a grid under one legend, as one SVG; `description` is what a screen reader says.

    `size` is that of one plot, px; one that lists names takes its height from them. Plots without a mark are left out.
    """
    plots = [plot for plot in plots if any(series.points for series in plot.series)]
    if not plots:
        return document(text(size[0] / 2, 40, "nothing was measured", "soft", "middle"), size[0], 70, description)
    columns = min(columns, len(plots))
    legend, top = _legend(_entries(plots), columns * size[0])
    parts = [legend]
    for first in range(0, len(plots), columns):
        row = plots[first : first + columns]
        height = max(_height(plot, size[1]) for plot in row)
        parts += [_plot(plot, place * size[0], top, (size[0], height)) for place, plot in enumerate(row)]
        top += height
    return document("".join(parts), columns * size[0], top, description)


def _height(plot: Plot, height: int) -> int:
    """A plot that lists names is as high as it has names."""
    return MARGIN_TOP + MARGIN_BOTTOM + NAMED_ROW * len(plot.y.names) if plot.y.names else height


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


Entry = tuple[str, Callable[[float, float], str]]
"""A name in the legend, and what draws its sign at a place (x, y)."""


def _entries(plots: Sequence[Plot]) -> list[Entry]:
    """Each series of the plots once: a dashed line where it has no marks, its mark otherwise."""
    known: dict[tuple[str, int, bool], Series] = {}
    for series in (series for plot in plots for series in plot.series if series.name):
        known.setdefault((series.name, series.color, series.hollow), series)
    return [(series.name, _sign(series)) for series in known.values()]


def _sign(series: Series) -> Callable[[float, float], str]:
    if series.points or not series.line:
        return lambda x, y: _mark(x, y, series.color, series.hollow)
    return lambda x, y: f'<path class="{_color(series.color)} front" d="M{x - 7:.1f} {y:.1f}h16"{_dashes(series)}/>'


def _legend(entries: Sequence[Entry], width: float) -> tuple[str, float]:
    """The legend in as many rows as it needs, and its height; none for a single series."""
    if len(entries) < 2:
        return "", 6
    parts, x, y = [], 16.0, 18.0
    for name, draw in entries:
        wide = 36 + 1.1 * LETTER * len(name)
        if x + wide > width - 10 and x > 16:
            x, y = 16.0, y + 20
        parts += [draw(x + 6, y - 4), text(x + 18, y, name)]
        x += wide
    return "".join(parts), y + 10


def _color(index: int) -> str:
    return f"s{index % len(LIGHT)}"


def _dashes(series: Series) -> str:
    return ' stroke-dasharray="5 4"' if series.hollow else ""


def _plot(plot: Plot, left: float, top: float, size: tuple[int, int]) -> str:
    names = LETTER * max((len(name) for name in plot.y.names), default=0)
    x0, x1 = left + max(MARGIN_LEFT, names + 28), left + size[0] - MARGIN_RIGHT
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
    taken: list[tuple[float, float, float]] = []
    for series in plot.series:
        if len(series.line) > 1:
            path = "L".join("{:.1f} {:.1f}".format(*at(*point)) for point in series.line)
            parts.append(f'<path class="{_color(series.color)} front" d="M{path}"{_dashes(series)}/>')
        parts += [_mark(*at(p.x, p.y), series.color, series.hollow, p.note, p.faded) for p in series.points]
    for series in plot.series if size[0] >= LABELLED else ():
        parts += [_label(*at(p.x, p.y), p.label, taken, x1) for p in series.points if p.label]
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


def _label(x: float, y: float, words: str, taken: list[tuple[float, float, float]], limit: float) -> str:
    """The text beside a mark, or nothing where another one stands already; the mark keeps its tooltip."""
    wide = 0.9 * LETTER * len(words)
    x = x + 8 if x + 8 + wide < limit else x - 8 - wide
    for shift in (-6, 14, -18, 26):
        place = (x, x + wide, y + shift)
        if not any(place[0] < right and left < place[1] and abs(place[2] - line) < 12 for left, right, line in taken):
            taken.append(place)
            return text(x, y + shift, words, "soft small")
    return ""


def bars(
    rows: Sequence[tuple[str, Sequence[float]]], parts: Sequence[str], unit: str, description: str, width: int = 720
) -> str:
    """Stacked horizontal bars: one row per label, one segment per part, the sum at the end."""
    legend, top = _legend([(name, _swatch(index)) for index, name in enumerate(parts)], width)
    left = 24 + LETTER * max(len(label) for label, _ in rows)
    most = max(max(sum(values) for _, values in rows), 1e-12)
    scale = (width - left - 90) / most
    body = []
    for index, (label, values) in enumerate(rows):
        y, x = top + 8 + 30 * index, left
        body.append(text(left - 10, y + 15, label, "ink", "end"))
        for part, value in enumerate(values):
            long = max(value * scale - 2, 0.5)  # a gap of two pixels keeps neighbours apart
            tip = f"<title>{escape(f'{label}, {parts[part]}: {value:.4g} {unit}')}</title>"
            box = f'x="{x:.1f}" y="{y:.1f}" width="{long:.1f}" height="20" rx="2"'
            body.append(f'<rect class="{_color(part)} edge" {box}>{tip}</rect>')
            x += value * scale
        body.append(text(x + 6, y + 15, f"{sum(values):.3g} {unit}", "soft"))
    return document(legend + "".join(body), width, top + 18 + 30 * len(rows), description)


def _swatch(color: int) -> Callable[[float, float], str]:
    """A piece of a bar, for the legend."""
    return lambda x, y: f'<rect class="{_color(color)} edge" x="{x - 6:.1f}" y="{y - 5:.1f}" width="12" height="10"/>'
