"""The report as one HTML page that needs nothing else, and as Markdown with the plots in files beside it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import NamedTuple

from d2_plugin.runs import tables
from d2_plugin.runs.report.svg import style
from d2_plugin.runs.rows import Row
from d2_plugin.runs.tables import Table

TITLE = "D²-4DGS: quality against run time"

CSS = """
:root{color-scheme:light dark;--page:#f6f5f2;--card:#fcfcfb;--ink:#1b1b1a;--soft:#5c5b57;--line:#e0dfda;--mark:#e7f0fb}
@media(prefers-color-scheme:dark){:root{--page:#111110;--card:#1a1a19;--ink:#f0efec;--soft:#b3b1aa;--line:#383835;
--mark:#1d3350}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--ink);font:16px/1.55 system-ui,sans-serif}
header,main,footer{max-width:1160px;margin:0 auto;padding:0 20px}
header{padding-top:44px}h1{font-size:2rem;line-height:1.2;margin:0 0 .4em}
h2{font-size:1.35rem;margin:0 0 .3em}h3{font-size:1rem;margin:1.6em 0 .5em}
p{max-width:72ch}.soft,figcaption,footer{color:var(--soft);font-size:.875rem}
nav{position:sticky;top:0;background:var(--page);border-bottom:1px solid var(--line);z-index:1}
nav ul{list-style:none;display:flex;flex-wrap:wrap;gap:4px 20px;max-width:1160px;margin:0 auto;padding:10px 20px}
a{color:inherit;text-underline-offset:3px}a:focus-visible,summary:focus-visible{outline:2px solid #2a78d6}
section{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:24px;margin:24px 0;
scroll-margin-top:60px}
figure{margin:18px 0;overflow-x:auto}svg.plot{display:block;max-width:100%;height:auto}
img{max-width:100%;border-radius:6px;display:block}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.8125rem;font-variant-numeric:tabular-nums;width:100%}
th,td{padding:5px 6px;text-align:right;border-bottom:1px solid var(--line);white-space:nowrap}
th{color:var(--soft);font-weight:500;vertical-align:bottom;white-space:normal}tbody tr:hover{background:var(--page)}
th.words,td.words{text-align:left}td.long{white-space:normal;min-width:26ch;text-align:left}
td.best{font-weight:650;background:var(--mark)}
summary{cursor:pointer;margin-top:1.4em}code{font-size:.85em;overflow-wrap:anywhere}
footer{padding:10px 20px 50px}
@media(max-width:700px){section{padding:16px}svg.plot{max-width:none}}
@media print{nav{display:none}section{break-inside:avoid-page}}
"""


@dataclass(frozen=True)
class Section:
    """One part of the report; `figures` are SVG by name, `tables` come with a title."""

    name: str
    title: str
    text: str
    figures: dict[str, str] = field(default_factory=dict)
    tables: tuple[tuple[str, Table], ...] = ()
    sources: tuple[str, ...] = ()


def sources_of(rows: Sequence[Row]) -> tuple[str, ...]:
    """One sentence per machine, commit and command that the rows come from."""
    return tuple(dict.fromkeys(map(_source, rows)))


def _source(row: Row) -> str:
    if row["device"] is None:
        return f"`{row['command']}`, which recorded neither machine nor commit."
    where = f"{row['device']}, {row['threads']} threads, torch {row['torch']}"
    return f"{where}, commit {row['commit'] or row['version']}, `{row['command']}`."


class Image(NamedTuple):
    """An image of a run as a data URI, with what it shows."""

    caption: str
    uri: str


def html(sections: Sequence[Section], images: Sequence[Image], lead: str) -> str:
    """The page; `lead` is the paragraph at its top."""
    entries = [(section.name, section.title.partition(":")[0]) for section in sections]
    entries += [("images", "Images")] if images else []
    links = "".join(f'<li><a href="#{name}">{escape(title)}</a></li>' for name, title in entries)
    body = "".join(map(_section, sections)) + (_gallery(images) if images else "")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{TITLE}</title><style>{CSS}{style()}</style></head>\n"
        f"<body><header><h1>{TITLE}</h1><p>{escape(lead)}</p></header>\n"
        f'<nav aria-label="Sections"><ul>{links}</ul></nav>\n<main>{body}</main>\n'
        "<footer><p>Made by <code>d2 report</code> from the rows that the commands above wrote; nothing is typed in. "
        "Marks carry their numbers as tooltips.</p></footer></body></html>\n"
    )


def _section(section: Section) -> str:
    rules = re.compile("<style>.*?</style>")  # the page states them once
    figures = "".join(f"<figure>{rules.sub('', svg)}</figure>" for svg in section.figures.values())
    tables = "".join(f"<h3>{escape(title)}</h3>{_table(table)}" for title, table in section.tables)
    sources = "".join(f"<p class='soft'>{_code(source)}</p>" for source in section.sources)
    if len(section.sources) > 2:
        made = f"Made by {len(section.sources)} commands"
        sources = f"<details><summary class='soft'>{made}</summary>{sources}</details>"
    return (
        f'<section id="{section.name}"><h2>{escape(section.title)}</h2><p>{escape(section.text)}</p>'
        f"{figures}{tables}{sources}</section>\n"
    )


def _code(sentence: str) -> str:
    """Markdown's backticks as code."""
    parts = escape(sentence).split("`")
    return "".join(f"<code>{part}</code>" if i % 2 else part for i, part in enumerate(parts))


def _table(table: Table) -> str:
    words = [any(_is_words(row[i]) for row in table.rows) for i in range(len(table.header))]
    head = "".join(f'<th scope="col"{_classes(words[i])}>{escape(t)}</th>' for i, t in enumerate(table.header))
    rows = []
    for index, row in enumerate(table.rows):
        cells = "".join(
            f"<td{_classes(words[i], len(cell) > 48, (index, i) in table.best)}>{escape(cell)}</td>"
            for i, cell in enumerate(row)
        )
        rows.append(f"<tr>{cells}</tr>")
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _is_words(cell: str) -> bool:
    """Whether a cell is text rather than a number or a dash; such columns are set to the left."""
    return bool(cell) and cell != "-" and not (cell[0].isdigit() or cell[0] in "+-")


def _classes(words: bool, long: bool = False, best: bool = False) -> str:
    chosen = [name for name, on in (("words", words), ("long", long), ("best", best)) if on]
    return f' class="{" ".join(chosen)}"' if chosen else ""


def _gallery(images: Sequence[Image]) -> str:
    figures = "".join(
        f'<figure><img src="{image.uri}" alt="{escape(image.caption)}" loading="lazy">'
        f"<figcaption>{escape(image.caption)}</figcaption></figure>"
        for image in images
    )
    return f'<section id="images"><h2>Images</h2><p>Held-out views.</p>{figures}</section>\n'


def markdown(sections: Sequence[Section], lead: str) -> str:
    """The same without images; the plots are the files `NAME.svg` beside it."""
    parts = [f"# {TITLE}", lead]
    for section in sections:
        parts += [f"## {section.title}", section.text]
        parts += [f"![{section.title}]({name}.svg)" for name in section.figures]
        for title, table in section.tables:
            parts += [f"**{title}**", tables.markdown(table)]
        parts += list(section.sources)
    return "\n\n".join(parts) + "\n"
