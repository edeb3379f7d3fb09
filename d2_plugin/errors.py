"""The one exception that a user is meant to read."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable

LONGEST_NAME = 100
"""Letters of an unknown name that an error repeats."""


class D2Error(ValueError):
    """A mistake in input or configuration, in one sentence: what, expected and got, what to do.

    The `d2` command prints it without a traceback and exits with code 2.
    """

    longest = 1200
    """Letters of a sentence; of one that repeats a damaged file's, the middle is left out."""

    def __str__(self) -> str:
        text, end = super().__str__(), self.longest // 4
        return text if len(text) <= self.longest else f"{text[: 3 * end]} ... {text[-end:]}"


class MissingExtra(D2Error, ImportError):
    """A feature was asked for whose optional packages are not installed."""


def missing_extra(package: str, extra: str, purpose: str) -> MissingExtra:
    """The error for an import of `package` that failed: names the purpose and the command that mends it."""
    return MissingExtra(f"{purpose} needs {package}, which is not installed: run `pip install 'd2-4dgs[{extra}]'`")


def unknown_name(kind: str, name: str, known: Iterable[str]) -> D2Error:
    """The error for a name that is not among `known`, with the nearest one suggested."""
    have = sorted(map(str, known))
    name = name if isinstance(name, str) else repr(name)
    near = [one for one in have if one.zfill(9) == name.zfill(9)]  # 3 for 03
    near = near or difflib.get_close_matches(name[:LONGEST_NAME], have, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    asked = " ".join((name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]} ...").splitlines())
    return D2Error(f"unknown {kind} '{asked}': have {', '.join(have) or 'none'}{hint}")


def refuse_unknown(kind: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raise `unknown_name` for the first of some names that is not among `known`."""
    for name in names:
        if name not in known:
            raise unknown_name(kind, name, known)
