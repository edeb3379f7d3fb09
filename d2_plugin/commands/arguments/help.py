"""The help of a command: each setting with its docstring, unit, range and default."""

from __future__ import annotations

import itertools
import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import MISSING

from d2_plugin.commands.arguments.form import HELP, Form, Section, is_switch, typed_as
from d2_plugin.commands.arguments.text import flag_of, item_kind, limits, placeholder, written
from d2_plugin.errors import unknown_name
from d2_plugin.settings import Declared
from d2_plugin.values import counted

COLUMN = 30
"""Where the explanations begin."""


def help_text(form: Form, words: Sequence[str]) -> str:
    """What `words` ask for: a command's own settings with a line per table, one table, or all of them."""
    sections = form.sections(words)
    if "--help-all" in words:
        return "\n\n".join([_overview(form), *(_table(section) for section in sections.values())])
    topics = [after for word, after in itertools.pairwise(words) if word in HELP and not after.startswith("-")]
    if not topics or not sections:
        return "\n\n".join([_overview(form), *([_tables(form, sections)] if sections else [])])
    topic = topics[-1].replace("-", "_").removesuffix(".*").rstrip(".")
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
    order = sorted(form.settings, key=lambda setting: (not setting.positional, setting.default is not MISSING))
    needed = [_typed(setting) for setting in order if setting.default is MISSING]
    more = ["[more flags]"] if len(needed) < len(order) else []
    parts = [f"usage: {' '.join([form.command, *needed, *more])}", form.about.strip()]
    entries = [entry(_typed(setting), _explained(setting)) for setting in order]
    return "\n\n".join([*(part for part in parts if part), "\n".join(entries)]).rstrip()


def _tables(form: Form, sections: dict[str, Section]) -> str:
    lines = ["Tables of settings; they may also stand in a --config file, and flags win:"]
    for name, section in sections.items():
        count = len(section.settings)
        lines.append(entry(f"{flag_of(name)}.*", f"{section.about} ({counted(count, 'setting')})"))
    foot = f"`{form.command} --help {next(iter(sections))}` shows the settings of one table"
    return "\n".join([*lines, "", f"{foot}, `{form.command} --help-all` all of them."])


def _table(section: Section) -> str:
    entries = [entry(f"{flag_of(s.name)} {placeholder(s.kind)}", _explained(s)) for s in section.settings]
    return "\n".join([f"[{section.name}] {section.about}".rstrip(), *entries])


def _typed(setting: Declared) -> str:
    if setting.positional:
        return typed_as(setting) + (" ..." if item_kind(setting.kind) is not None else "")
    return typed_as(setting) if is_switch(setting) else f"{typed_as(setting)} {placeholder(setting.kind)}"


def _explained(setting: Declared) -> str:
    where = limits(setting)
    bounds = ", ".join(part for part in (where.unit, where.described()) if part not in ("", "finite"))
    facts = [bounds, "needed" if setting.default is MISSING else _default(setting)]
    facts_text = "; ".join(fact for fact in facts if fact)
    return f"{setting.help} ({facts_text})".strip() if facts_text else setting.help


def _default(setting: Declared) -> str:
    """The default where it is a value: not for what is left out, and not for a switch that is off."""
    off = setting.default is False and "." not in setting.name
    if off or setting.default is None or setting.default in ("", ()):
        return ""
    return f"default {written(setting.default)}"
