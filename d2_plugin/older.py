"""What newer Pythons bring along, for trainers whose environments pin an older one: Python 3.9 and up.

The two packages that stand in come with d2-4dgs where Python is older (setup.cfg); newer ones never load them.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any, ForwardRef, get_type_hints

from d2_plugin.errors import D2Error

__all__ = ["hints_of", "tomllib"]


def stand_in(module: str, package: str, use: str) -> Any:
    """A module that this Python does not have itself, from a package that has it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        version = ".".join(map(str, sys.version_info[:2]))
        raise D2Error(f"Python {version} cannot {use} by itself: run `pip install {package}`") from None


def hints_of(kind: Any) -> dict[str, Any]:
    """The annotations of a class and its bases, or of a function, evaluated: `A | B` and `Annotated` included, also on
    Python 3.9."""
    if sys.version_info >= (3, 10):
        return get_type_hints(kind, include_extras=True)
    return backported_hints(kind)


def backported_hints(kind: Any) -> dict[str, Any]:
    """`hints_of` where Python cannot evaluate `A | B`: pydantic's stand-in reads it as `Union[A, B]`."""
    evaluated = stand_in("eval_type_backport", "eval-type-backport", "read annotations like `int | None`")
    found: dict[str, Any] = {}
    for base in reversed(getattr(kind, "__mro__", (kind,))):
        names = vars(sys.modules[base.__module__])
        for name, text in vars(base).get("__annotations__", {}).items():
            if isinstance(text, str):
                reference = ForwardRef(text, is_argument=False)
                found[name] = evaluated.eval_type_backport(reference, names, dict(vars(base)), try_default=False)
            else:
                found[name] = text  # made by make_dataclass
    return found


if sys.version_info >= (3, 11):
    import tomllib  # novermin: the branch of the Pythons that have it
else:
    tomllib = stand_in("tomli", "tomli", "read TOML")
