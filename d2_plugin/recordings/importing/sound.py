"""When two cameras started, from the sound of both: the generalised cross-correlation with phase transform.

With the spectra A and B of the two sounds, the inverse transform of A conj(B) / |A conj(B)| has its peak at the lag of
one behind the other: every frequency counts alike, so loudness, distance and the microphone's colour do not matter
(Knapp and Carter 1976). Sound itself takes 2.9 ms per metre, which no correlation can know.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from d2_plugin.recordings.importing.video import begin_of, container_of, pyav

RATE = 16_000  # samples per second that are compared
BAND = (100.0, 4000.0)  # hertz: below is wind and hum, above is what lossy sound loses first
MOST_SECONDS = 900.0  # of the sound that is read

CLEAR = 12.0
"""A peak this many standard deviations of the correlation high is an event that both recorded. The largest of a million
samples of noise reaches 5."""

DOUBTFUL = 0.6
"""Another peak of this share of the highest makes it doubtful: a sound that repeats itself, or two events."""

BLUNT = 0.45
"""As much within `ECHO` is no single peak: two claps of different events, laid over each other, look like that."""

ECHO, SHARP = 0.1, 0.001  # seconds around a peak in which others are its echoes, and in which they are the peak itself
LEAST_SECONDS = 0.3  # of a sound that says anything

PART, PARTS = 1.0, 6
"""Seconds of the shortest part, and how many, in which the lag is looked for again: they say how sure it is."""

AROUND = 0.05  # seconds around the lag of the whole within which that of a part is looked for


class Sound(NamedTuple):
    """The sound of a camera, one channel."""

    samples: np.ndarray  # [N] float32 at `RATE` samples per second
    start: float  # seconds of the first sample on the clock of the file, which the frames share


class Lag(NamedTuple):
    """When the other camera started, after the first one."""

    seconds: float
    error: float  # standard error, seconds


def read_sound(path: Path) -> Sound | None:
    """The sound of a video, or None where it has none to speak of."""
    with container_of(path) as container:
        if not container.streams.audio:
            return None
        resampler = pyav().AudioResampler(format="fltp", layout="mono", rate=RATE)
        start, length, parts = None, 0, []
        for frame in container.decode(audio=0):
            for part in resampler.resample(frame):
                if start is None:
                    start = float(part.pts * part.time_base) - begin_of(container) if part.pts is not None else 0.0
                parts.append(part.to_ndarray()[0])
                length += len(parts[-1])
            if length > MOST_SECONDS * RATE:
                break
        samples = np.concatenate(parts) if parts else np.zeros(0, np.float32)
    silent = len(samples) < LEAST_SECONDS * RATE or float(np.abs(samples).max(initial=0)) < 1e-4
    return None if silent else Sound(samples, start or 0.0)


def lag_between(one: Sound, other: Sound) -> Lag | None:
    """How long after `one` the clock of `other` began; None where they share no clear event.

    An event at second s of `other` is at second s + lag of `one`. The error is that of the median over parts of the
    common time, each of which is searched anew near the lag of the whole.
    """
    correlation = phase_transform(one.samples, other.samples)
    peak = _clear_peak(correlation)
    if peak is None:
        return None
    lag = _between_samples(correlation, peak) / RATE
    parts = _lags_of_parts(one.samples, other.samples, lag)
    error = 1 / RATE
    if len(parts) > 1:
        spread = 1.4826 * float(np.median(np.abs(parts - np.median(parts))))
        error = max(1.2533 * spread / np.sqrt(len(parts)), error)
    return Lag(lag + one.start - other.start, error)


def phase_transform(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Correlation over lags -n..n-1 as `numpy.fft` orders them: entry k is high where one[i + k] is other[i]."""
    size = 1 << int(np.ceil(np.log2(len(one) + len(other))))
    cross = np.fft.rfft(one, size) * np.conj(np.fft.rfft(other, size))
    frequencies = np.fft.rfftfreq(size, 1 / RATE)
    strength = np.abs(cross)
    inside = (frequencies >= BAND[0]) & (frequencies <= BAND[1])
    # What is next to silent has a phase of nothing but noise: it must not count like the rest.
    floor = 1e-3 * float(strength[inside].mean()) + 1e-20
    return np.fft.irfft(np.where(inside, cross / (strength + floor), 0), size)


def _clear_peak(correlation: np.ndarray) -> int | None:
    """Place of the highest peak, None where it does not stand out or another one comes near."""
    peak = int(correlation.argmax())
    noise = 1.4826 * float(np.median(np.abs(correlation))) + 1e-20
    highest, echo, sharp = float(correlation[peak]), int(ECHO * RATE), int(SHARP * RATE)
    around = np.abs(np.roll(correlation, -peak))
    far, near = around[echo:-echo], np.concatenate([around[sharp:echo], around[-echo:-sharp]])
    stands_out = highest >= CLEAR * noise and highest * BLUNT >= float(near.max())
    return peak if stands_out and highest * DOUBTFUL >= float(far.max(initial=0)) else None


def _between_samples(correlation: np.ndarray, peak: int) -> float:
    """The lag of a peak in samples, by the parabola through its neighbours."""
    size = len(correlation)
    low, top, high = (float(correlation[(peak + step) % size]) for step in (-1, 0, 1))
    bend = low - 2 * top + high
    shift = 0.5 * (low - high) / bend if bend < 0 else 0.0
    return (peak if peak < size // 2 else peak - size) + shift


def _lags_of_parts(one: np.ndarray, other: np.ndarray, lag: float) -> np.ndarray:
    """Lags in seconds [n] of the parts that share a clear event."""
    shift = round(lag * RATE)
    begin, end = max(shift, 0), min(len(one), len(other) + shift)
    count = int(min(max((end - begin) / (PART * RATE), 1), PARTS))
    reach, lags = int(AROUND * RATE), []
    edges = np.linspace(begin, end, count + 1).astype(int)
    for first, last in pairwise(edges):
        correlation = phase_transform(one[first:last], other[first - shift : last - shift])
        near = np.concatenate([correlation[-reach:], correlation[:reach]])
        noise = 1.4826 * float(np.median(np.abs(correlation))) + 1e-20
        if near.max() >= 5 * noise:
            peak = (int(near.argmax()) - reach) % len(correlation)
            lags.append((shift + _between_samples(correlation, peak)) / RATE)
    return np.array(lags)
