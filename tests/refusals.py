"""Calls that are refused: with one sentence, on one line."""

import re
from collections.abc import Callable
from typing import Any

import pytest

from d2_plugin.errors import D2Error


def refuses(says: str, call: Callable[..., Any], /, *given: Any, error: type[D2Error] = D2Error, **named: Any) -> None:
    """The call raises the error, whose one line holds what the pattern says."""
    with pytest.raises(error) as caught:
        call(*given, **named)
    text = str(caught.value)
    assert re.search(says, text), text
    assert "\n" not in text, text
