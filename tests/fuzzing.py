"""Mutations of valid files, drawn from a seed: what is wrong about them is that nobody wrote them so."""

import json
import os
import random
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from d2_plugin.errors import D2Error

ODD_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**30, 10**299, -(2**40), 0.5, -0.0, 1e-300, 1e300, -1e300),
    *("", "a", "a,b", "..", "../../x", "/etc/passwd", "\x00", "nan", "1e999", "é" * 300, "<script>", "\n", "0", "none"),
    *([], {}, [[]], [1, 2, 3], [[1, 0], [0, 1]], {"a": {}}, ["x"] * 20, [None], [0] * 100),
)
"""What takes the place of a parsed value."""

ODD_TEXTS = (
    *("NaN", "Infinity", "-Infinity", "1e999", "1" * 5000, "[" * 3000, '"\\ud800"', "0x10", "1_000", "--", "%", "\x00"),
    *("{", "}", "]", '"', "\\", "é", "\ufeff", "!!", "&a", "*a", "<<", "9" * 400, "1e-400", "true", "\n", "\t", " "),
)
"""What takes the place of a piece of text."""

SEED = int(os.environ.get("FUZZ_SEED", "1"))
"""Of the slow rounds: another number draws another set."""

MOST_SECONDS = 60.0
"""No single mutation may take longer, on a machine that others use as well: a video decoder tries hard."""

MOST_MEGABYTES = 1500
"""No run of mutations may raise this process's peak memory by more."""


def mutated_bytes(data: bytes, rng: random.Random) -> bytes:
    """The same bytes with a few changes: flips, cuts, repeats, inserted noise, extreme numbers, odd texts."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        place = rng.randrange(len(changed) + 1)
        if rng.random() < 0.3:
            place = min(place, rng.randrange(1, 200))  # headers are where it hurts
        length = min(rng.choice((1, 1, 2, 4, 8, 64)), max(len(changed) - place, 0))
        match rng.randrange(8):
            case 0 if length:
                changed[place] ^= 1 << rng.randrange(8)
            case 1:
                del changed[place:]
            case 2:
                del changed[place : place + length]
            case 3:
                changed[place:place] = changed[place : place + length] * rng.randrange(1, 4)
            case 4:
                changed[place : place + length] = rng.randbytes(length)
            case 5:
                changed[place : place + length] = rng.choice((b"\xff", b"\x00", b"\x7f")) * length
            case 6:
                changed[place : place + length] = rng.choice(ODD_TEXTS).encode("utf-8", "surrogatepass")
            case _:
                other = rng.randrange(len(changed) + 1)
                changed[place : place + length] = changed[other : other + length]
    return bytes(changed)


def mutated_value(value: Any, rng: random.Random) -> Any:
    """A parsed value with one or two places inside it replaced, scaled, removed or doubled."""
    for _ in range(rng.choice((1, 1, 2))):
        value = _replaced(value, rng)
    return value


def mutated_text(text: str, rng: random.Random) -> str:
    """A text with one of its words, or a line, replaced, removed or doubled."""
    separator = rng.choice((" ", "\n"))
    words = text.split(separator)
    place = rng.randrange(len(words))
    replacement = rng.choice(([], [words[place]] * 2, [rng.choice(ODD_TEXTS)], [str(rng.choice(ODD_VALUES))]))
    return separator.join([*words[:place], *replacement, *words[place + 1 :]])


def mutate_file(path: Path, rng: random.Random) -> None:
    """Change a file in place: its bytes or, where it is JSON, its values, and now and then a text's words."""
    data = path.read_bytes()
    kind = rng.random()
    if path.suffix == ".json" and kind < 0.7:
        path.write_text(json.dumps(mutated_value(json.loads(data), rng)))
    elif path.suffix in (".txt", ".yml", ".toml", ".jsonl", ".md") and kind < 0.6:
        path.write_text(mutated_text(data.decode(), rng), errors="surrogatepass")
    else:
        path.write_bytes(mutated_bytes(data, rng))


def leaves(value: Any) -> list[Any]:
    """What a value holds, to be compared."""
    if isinstance(value, dict):
        return [leaf for name in sorted(value, key=str) for leaf in (str(name), *leaves(value[name]))]
    if isinstance(value, list | tuple):
        return [leaf for item in value for leaf in leaves(item)]
    if isinstance(value, torch.Tensor | np.ndarray):
        return [str(value.dtype), tuple(value.shape), np.asarray(value).tobytes()]
    return [value]


def expect_result_or_sentence(call: Callable[[], Any], seed: object, expected: list[Any] | None = None) -> bool:
    """Whether `call` gave a result, with the leaves that are `expected`; a D2Error of one sentence is as good.

    Anything else fails with the seed.
    """
    start = time.monotonic()
    try:
        found, refused = call(), None
    except D2Error as error:
        refused = str(error)
    except Exception as failure:
        raise AssertionError(f"mutation {seed}: {type(failure).__name__}: {failure}") from failure
    assert time.monotonic() - start < MOST_SECONDS, f"mutation {seed} took {time.monotonic() - start:.1f} s"
    if refused is not None:
        assert 10 < len(refused) < (2000 if expected is None else 1000), f"mutation {seed}: {refused[:3000]}"
        assert expected is None or "\n" not in refused, f"mutation {seed}: {refused}"
        refused.encode()
    assert refused is not None or expected is None or leaves(found) == expected, f"mutation {seed}"
    return refused is None


@contextmanager
def bounded_memory() -> Iterator[None]:
    """Fail where the peak memory of this process rises by more than `MOST_MEGABYTES`."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    risen = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert risen < MOST_MEGABYTES, f"peak memory rose by {risen:.0f} MB"


def _replaced(value: Any, rng: random.Random) -> Any:
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        if rng.random() < 0.1:
            return {name: inner for name, inner in value.items() if name != key}
        if rng.random() < 0.05:
            return value | {str(rng.choice(ODD_VALUES)): value[key]}
        return value | {key: _replaced(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        place = rng.randrange(len(value))
        if rng.random() < 0.1:
            return value[:place] + value[place + 1 :] if rng.random() < 0.5 else [*value, value[place]]
        return [*value[:place], _replaced(value[place], rng), *value[place + 1 :]]
    if isinstance(value, int | float) and not isinstance(value, bool) and rng.random() < 0.3:
        return value * rng.choice((-1, 0, 1e-9, 1e9, 1e30, 2, 0.5))
    return rng.choice(ODD_VALUES)
