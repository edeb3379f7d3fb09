"""The help of a command: each setting with unit, range, default and the evidence in its docstring."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Collection, Sequence
from dataclasses import MISSING

from d2_plugin.commands.arguments.form import HELP, Form, Section, typed_as
from d2_plugin.commands.arguments.text import bare, flag_of, item_kind, limits, placeholder, shown
from d2_plugin.errors import unknown_name
from d2_plugin.settings import Declared, Range

COLUMN = 30
"""Where the explanations begin."""


def help_text(form: Form, words: Sequence[str]) -> str:
    """What `words` ask for: a command's own settings with a line per table, one table, or all of them."""
    sections = form.sections(words)
    if "--help-all" in words:
        return "\n\n".join([_overview(form), *(_table(section) for section in sections.values())])
    topic = _topic(words)
    if topic is None or not sections:
        return "\n\n".join([_overview(form), *([_tables(form, sections.values())] if sections else [])])
    chosen = [section for name, section in sections.items() if name == topic or name.startswith(f"{topic}.")]
    if not chosen:
        raise unknown_name("table of settings", topic, sections)
    return "\n\n".join(_table(section) for section in chosen)


def entry(title: str, text: str) -> str:
    """A title with its explanation beside it, or below where the title is long."""
    width = min(shutil.get_terminal_size((100, 24)).columns, 110)
    lines = textwrap.wrap(text, max(width - COLUMN, 30), break_long_words=False, break_on_hyphens=False) or [""]
    first = f"  {title:{COLUMN - 2}}" if len(title) < COLUMN - 3 else f"  {title}\n{' ' * COLUMN}"
    return (first + f"\n{' ' * COLUMN}".join(lines)).rstrip()


def _overview(form: Form) -> str:
    needed = [setting for setting in form.settings if setting.default is MISSING]
    usage = " ".join([form.command, *(_typed(setting) for setting in sorted(needed, key=lambda s: not s.positional))])
    more = " [more flags]" if len(needed) < len(form.settings) else ""
    parts = [f"usage: {usage}{more}", form.about.strip()]
    order = sorted(form.settings, key=lambda setting: (not setting.positional, setting.default is not MISSING))
    entries = [entry(_typed(setting), _explained(setting)) for setting in order]
    return "\n\n".join([*(part for part in parts if part), "\n".join(entries)]).rstrip()


def _tables(form: Form, sections: Collection[Section]) -> str:
    """One line per table."""
    titles = [entry(f"--{section.name.replace('_', '-')}.*", _counted(section)) for section in sections]
    head = "Tables of settings; they may also stand in a --config file, and flags win:"
    foot = (
        f"`{form.command} --help {next(iter(sections)).name}` shows the settings of one table, "
        f"`{form.command} --help-all` all of them."
    )
    return "\n".join([head, *titles, "", foot])


def _counted(section: Section) -> str:
    count = len(section.settings)
    return f"{section.about} ({count} setting{'' if count == 1 else 's'})".strip()


def _table(section: Section) -> str:
    flags = [s._replace(name=f"{section.name}.{s.name}", positional=False) for s in section.settings]
    entries = [entry(f"{flag_of(s.name)} {placeholder(s.kind)}", _explained(s)) for s in flags]
    return "\n".join([f"[{section.name}] {section.about}".rstrip(), *entries])


def _typed(setting: Declared) -> str:
    """A setting as it is typed."""
    if setting.positional:
        return typed_as(setting) + (" ..." if item_kind(setting.kind) is not None else "")
    return typed_as(setting) if bare(setting.kind) is bool else f"{typed_as(setting)} {placeholder(setting.kind)}"


def _explained(setting: Declared) -> str:
    """The docstring, then range, unit and default."""
    facts = [_bounds(limits(setting)), "needed" if setting.default is MISSING else _default(setting)]
    facts_text = "; ".join(fact for fact in facts if fact)
    return f"{setting.help} ({facts_text})".strip() if facts_text else setting.help


def _bounds(where: Range) -> str:
    bounds = where.described()
    return ", ".join(part for part in (where.unit, bounds) if part not in ("", "finite"))


def _default(setting: Declared) -> str:
    """The default where it is a value: not for what is left out, and not for a switch that is off."""
    off = setting.default is False and "." not in setting.name
    if off or setting.default is None or setting.default in ("", ()):
        return ""
    return f"default {shown(setting.default)}"


def _topic(words: Sequence[str]) -> str | None:
    """The word behind --help."""
    for word, following in zip(words, [*words[1:], "-"]):
        if word in HELP and not following.startswith("-"):
            return following.replace("-", "_").removesuffix(".*").rstrip(".")
    return None
