"""What a command takes, made from declared settings: the one way from words on a command line to checked values.

Flags, types, ranges, defaults and help are those of the dataclasses (`d2_plugin.settings.declared`). A setting marked
`Positional` is taken by its place, a switch of the command stands alone, any other flag takes one word. Tables of
settings are given by dotted flags, as `--priors.stereo.min-angle 2`.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_args

from d2_plugin.commands.arguments.text import bare, flag_of, item_kind, read
from d2_plugin.durable import refuse_inside_images
from d2_plugin.errors import D2Error
from d2_plugin.settings import Declared, declared

log = logging.getLogger(__name__)

Made = TypeVar("Made")

HELP = ("--help", "-h", "--help-all")


@dataclass(frozen=True)
class Given:
    """What a person gave, checked, with the defaults of the rest."""

    values: dict[str, Any]
    """By the name of the setting."""
    tables: dict[str, Any] = field(default_factory=dict)
    """Settings given by dotted flags, nested as TOML nests them; without defaults."""

    def make(self, kind: Callable[..., Made], **more: Any) -> Made:
        """An instance of a dataclass from the values that it declares, and `more`."""
        names = {setting.name for setting in declared(kind)}
        return kind(**{name: value for name, value in self.values.items() if name in names} | more)


class Group(NamedTuple):
    """A table of settings: the dataclass that declares it, and what of it is given elsewhere."""

    kind: type
    without: tuple[str, ...] = ()


class Section(NamedTuple):
    """One table with its dotted name; its settings have dotted names too."""

    name: str
    about: str
    settings: tuple[Declared, ...]


@dataclass(frozen=True)
class Form:
    """The words that a command understands, and what it does with them."""

    command: str
    """As it is typed, `d2 train`."""
    about: str
    settings: tuple[Declared, ...]
    run: Callable[[Given], str | None]
    """Does the work; what it returns is printed."""
    groups: Callable[[Mapping[str, str]], Mapping[str, Group]] = lambda typed: {}
    """Tables of settings by name. They may depend on what was typed for other flags, as those of the backbone do."""
    readers: Mapping[str, Callable[[str], Any]] = field(default_factory=dict)
    """Settings that are written in a way of their own."""

    @classmethod
    def of(cls, command: str, about: str | None, kind: Callable[..., Made], run: Callable[[Made], str | None]) -> Form:
        """The form of a command that takes the settings of one dataclass and nothing else."""
        return cls(command, about or "", declared(kind), lambda given: run(given.make(kind)))

    def parse(self, words: Sequence[str]) -> Given:
        """The checked values of a command line.

        Raises:
            D2Error: an unknown flag, with the nearest one suggested; a wrong, missing or surplus value.
        """
        places, given = self._split(words)
        values = {s.name: s.default for s in self.settings if s.default is not MISSING} | self._placed(places)
        tables: dict[str, Any] = {}
        for setting, text in given.values():
            value = self._read(setting, [text])
            *path, last = setting.name.split(".")
            table = tables if path else values
            for part in path:
                table = table.setdefault(part, {})
            table[last] = _as_toml(value) if path else value
        for place in (values.get("output"), values.get("page")):
            if isinstance(place, Path):
                refuse_inside_images(place)
        missing = [typed_as(setting) for setting in self.settings if setting.name not in values]
        if missing:
            raise D2Error(f"{self.command} needs {' and '.join(missing)}: `{self.command} --help` says what that is")
        return Given(values, tables)

    def sections(self, words: Sequence[str]) -> dict[str, Section]:
        """All tables of a command line by their dotted names, those inside others too."""
        groups = self.groups(_typed(words))
        sections = [s for name, group in groups.items() for s in _sections(name, group.kind, group.without)]
        return {section.name: section for section in sections}

    def _split(self, words: Sequence[str]) -> tuple[list[str], dict[str, tuple[Declared, str]]]:
        """Words taken by their place, and each setting that is given by a flag with its word, by name."""
        places, given, left = list[str](), dict[str, tuple[Declared, str]](), iter(words)
        flags = {flag_of(setting.name): setting for setting in self.settings if not setting.positional}
        if any("." in word for word in words if _is_flag(word)):
            flags |= {flag_of(s.name): s for section in self.sections(words).values() for s in section.settings}
        for word in left:
            if not _is_flag(word):
                places.append(word)
                continue
            flag, attached, text = word.partition("=")
            setting = flags.get(flag.replace("_", "-"))
            if setting is None:
                raise D2Error(f"unknown flag {flag} of {self.command}{self._hint(flag, words)}")
            if is_switch(setting) and not attached:
                text = "true"
            elif not attached:
                text = next(left, "--none")
                if _is_flag(text):
                    raise D2Error(f"{flag} needs a value: `{self.command} --help` says which")
            if setting.name in given and item_kind(setting.kind) is not None:
                log.warning("%s is given twice and %s counts alone: several go in one, with commas", flag, text)
            given[setting.name] = setting, text
        return places, given

    def _hint(self, flag: str, words: Sequence[str]) -> str:
        """The flag that was meant, spelled out, or given without the name of its table."""
        own = [setting.name for setting in self.settings if not setting.positional]
        names = [*own, *(s.name for section in self.sections(words).values() for s in section.settings)]
        spelled = {flag_of(name.rpartition(".")[2]): flag_of(name) for name in reversed(names)}
        spelled |= {flag_of(name): flag_of(name) for name in names}
        near = difflib.get_close_matches(flag.replace("_", "-"), spelled, n=1)
        return f"; did you mean {spelled[near[0]]}?" if near else f": `{self.command} --help` lists the flags"

    def _read(self, setting: Declared, texts: Sequence[str]) -> Any:
        if setting.name in self.readers:
            return self.readers[setting.name](",".join(texts))
        return read(setting, texts, typed_as(setting))

    def _placed(self, words: Sequence[str]) -> dict[str, Any]:
        left, values = list(words), {}
        for setting in (s for s in self.settings if s.positional):
            count = len(left) if item_kind(setting.kind) is not None else 1
            taken, left = left[:count], left[count:]
            if taken:
                values[setting.name] = self._read(setting, taken)
        if left:
            raise D2Error(f"{self.command} has no place for '{left[0]}': `{self.command} --help` says what it takes")
        return values


class ModuleCommand(NamedTuple):
    """A command that a module serves: a class of settings and `run(settings) -> str`. Imported when it is asked for."""

    module: str
    settings: str
    """Name of the class of settings in that module."""
    help: str

    def form(self, command: str) -> Form:
        """What it takes; the docstring of its module is the text above the help."""
        module = importlib.import_module(self.module)
        return Form.of(command, inspect.cleandoc(module.__doc__ or ""), getattr(module, self.settings), module.run)


def typed_as(setting: Declared) -> str:
    """How a person names a setting: by its flag, or in capitals where it is taken by its place."""
    return setting.name.upper() if setting.positional else flag_of(setting.name)


def _sections(name: str, kind: type, without: tuple[str, ...] = ()) -> Iterator[Section]:
    settings = [setting for setting in declared(kind) if setting.name not in without]
    inner = {s.name: option for s in settings for option in (s.kind, *get_args(s.kind)) if is_dataclass(option)}
    text = (kind.__doc__ or "").strip()
    about = "" if text.startswith(f"{kind.__name__}(") else text.partition("\n")[0]  # not what dataclass makes
    flags = (s._replace(name=f"{name}.{s.name}", positional=False) for s in settings if s.name not in inner)
    yield Section(name, about, tuple(flags))
    for place, option in inner.items():
        if isinstance(option, type):
            yield from _sections(f"{name}.{place}", option)


def is_switch(setting: Declared) -> bool:
    """Whether a flag stands alone; what is on by default, and what stands in a table, takes true or false."""
    return bare(setting.kind) is bool and "." not in setting.name and setting.default is not True


def _is_flag(word: str) -> bool:
    return re.match(r"--?[A-Za-z]", word) is not None


def _typed(words: Sequence[str]) -> dict[str, str]:
    """The word behind each flag by the flag's name, read without knowing the flags."""
    values = {}
    for word, following in zip(words, [*words[1:], ""]):
        if _is_flag(word):
            flag, attached, value = word.partition("=")
            values[flag.lstrip("-").replace("-", "_")] = value if attached else following
    return values


def _as_toml(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_as_toml(item) for item in value]
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)
