# SPDX-License-Identifier: Apache-2.0
"""Instants that pairs of cameras share, from what their microphones hear.

Coarse: increases of energy in a few bands (onsets) are correlated over all lags; levels and tone of microphones do
not matter. Fine: in windows with many onsets, cross-correlation of the phases of both spectra (GCC-PHAT: Knapp and
Carter, 1976), whose peak is the direct path even where a room echoes. Spectra are compared at the same frequencies in
hertz, so sample rates may differ.

Sound needs 2.9 ms a metre: a camera that stands a metre farther from it seems that much late.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair
from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.correlation import Signal, best_lag
from structgstream.preparation.synchronization.solving import Tie

SPEED_OF_SOUND = 343.0  # metres a second, at 20 degrees Celsius
STEP_SECONDS = 0.004  # of onsets
BANDS_HERTZ = (150.0, 600.0, 1500.0, 3500.0, 8000.0)
LEAST_OVERLAP_SECONDS = 1.0
RIVAL_RATIO = 0.8  # of the second best lag to the best one
COARSE_RIVAL_RATIO = 0.5  # the same, where phases do not confirm the lag
CHANCE_DEVIATIONS = 7.0  # that a coarse peak exceeds: the largest of 300000 normal numbers is at 4.5
WINDOW_SECONDS, MOST_WINDOWS = 2, 16
GRID_HERTZ = 96000  # of the fine correlation
FINE_SIGMA_SECONDS = 1e-4  # of a window's peak in a room that echoes
LEAST_STANDING_OUT = 6.0  # of a fine peak, over the root mean square of the correlation
AGREEING_SECONDS, MOST_DRIFT = 1.5e-4, 2e-4  # between windows
LEAST_AGREEING, LEAST_AGREEING_SHARE = 4, 0.4
SMOOTHING_BINS = 101  # over which spectra are made white
STRIDES = (1, 2, 3, 5)  # between partners, where there are more cameras than the next number
ALL_PAIRS = 12


@dataclass(frozen=True)
class Sound:
    """Mono samples ``[N]`` at ``rate`` hertz and their onsets."""

    samples: NDArray[np.float32]
    rate: float
    onsets: Signal


def sound_of(name: str, audio: tuple[NDArray[np.float32], float]) -> Sound:
    """What camera ``name`` recorded.

    Raises:
        CaptureError: silence, or less than a second.
    """
    samples, rate = audio
    if len(samples) < LEAST_OVERLAP_SECONDS * rate:
        raise CaptureError(
            f"Camera {name!r} has {len(samples) / rate:.2f} s of sound; expected at least {LEAST_OVERLAP_SECONDS:g} "
            "s to "
            "compare with other cameras. Synchronise by motion or timestamps.csv."
        )
    if not np.ptp(samples) > 0:
        raise CaptureError(
            f"The sound of camera {name!r} is silence; switch its microphone on, or synchronise by motion or "
            "timestamps.csv."
        )
    return Sound(samples, rate, _onsets(samples, rate))


def distances_from(position: Floats, cameras: Mapping[str, LensCamera]) -> dict[str, float]:
    """Metres from each camera to where a sound was made, ``[3]``, for a calibration in metres."""
    return {name: float(np.linalg.norm(own.camera.center.numpy() - position)) for name, own in cameras.items()}


def audio_ties(sounds: Mapping[str, Sound], *, distances: Mapping[str, float] | None = None) -> list[Tie]:
    """Ties of the pairs of cameras that hear the same; pairs whose best lag is ambiguous have none.

    Args:
        sounds: camera to what it recorded.
        distances: camera to its distance from the source of the sound in metres, where it is known.
    """
    delays = {name: (distances[name] / SPEED_OF_SOUND if distances else 0.0) for name in sounds}
    ties = []
    for first, second in _pairs(list(sounds)):
        ties += _pair_ties(first, second, sounds, delays)
    return ties


def _pairs(names: list[str]) -> list[Pair]:
    if len(names) <= ALL_PAIRS:
        return list(combinations(names, 2))
    return [(names[i], names[(i + stride) % len(names)]) for stride in STRIDES for i in range(len(names))]


def _pair_ties(first: str, second: str, sounds: Mapping[str, Sound], delays: Mapping[str, float]) -> list[Tie]:
    one, other = sounds[first], sounds[second]
    least = round(LEAST_OVERLAP_SECONDS / STEP_SECONDS)
    coarse = best_lag(one.onsets, other.onsets, least_overlap=least)
    if coarse is None or coarse.rival > RIVAL_RATIO * coarse.judged:
        return []
    if coarse.judged < CHANCE_DEVIATIONS * coarse.deviation:
        return []
    confidence = coarse.judged / max(coarse.rival, 0.01)
    found = [
        (middle, lag)
        for middle in _windows(one.onsets, other.onsets, coarse.seconds)
        if (lag := _phase_lag(one, other, middle, coarse.seconds)) is not None
    ]
    agreeing = _on_a_line(found)
    if not agreeing and coarse.rival > COARSE_RIVAL_RATIO * coarse.judged:
        return []  # a bang of one place agrees with a bang of another
    if not agreeing:
        agreeing, sigma, confidence = [(coarse.middle, coarse.seconds)], STEP_SECONDS, confidence / 4
    else:
        sigma = FINE_SIGMA_SECONDS
    return [
        Tie(first, second, at - delays[first], at + lag - delays[second], sigma, confidence) for at, lag in agreeing
    ]


def _on_a_line(found: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The windows (time, lag) that agree with most others on a lag and a drift; none if too few do.

    Echoes and noise give lags that are spread over the range that is searched, so a few that agree are right.
    """
    if len(found) < LEAST_AGREEING:
        return []
    times, lags = np.array(found).T
    best = np.zeros(len(found), bool)
    for i, j in combinations(range(len(found)), 2):
        slope = (lags[j] - lags[i]) / (times[j] - times[i]) if times[i] != times[j] else np.inf
        for drift in (0.0, slope):
            if abs(drift) <= MOST_DRIFT:
                on = np.abs(lags - lags[i] - drift * (times - times[i])) < AGREEING_SECONDS
                best = on if on.sum() > best.sum() else best
    if best.sum() < max(LEAST_AGREEING, LEAST_AGREEING_SHARE * len(found)):
        return []
    return [pair for pair, agrees in zip(found, best, strict=True) if agrees]


def _onsets(samples: NDArray[np.float32], rate: float) -> Signal:
    """Increases ``[T, B]`` of the logarithm of the energy in each band, above the band's usual energy."""
    from scipy.signal import butter, sosfilt

    count = int(len(samples) / rate / STEP_SECONDS)
    bounds = np.rint(np.arange(count + 1) * STEP_SECONDS * rate).astype(int)
    channels = []
    for low, high in pairwise(BANDS_HERTZ):
        if low >= 0.4 * rate:
            continue
        filter_ = butter(2, (low, min(high, 0.45 * rate)), "bandpass", fs=rate, output="sos")
        power = np.asarray(sosfilt(filter_, samples)) ** 2
        energy = np.add.reduceat(power, bounds[:-1])[:count] / np.diff(bounds)
        level = np.log(energy + max(float(np.median(energy)), 1e-12 * float(energy.max()), 1e-30))
        channels.append(np.maximum(np.diff(level, prepend=level[0]), 0.0))
    return Signal(np.stack(channels, axis=1), STEP_SECONDS / 2, STEP_SECONDS)


def _windows(one: Signal, other: Signal, lag: float) -> list[float]:
    """Middles, by the first camera's clock, of the windows with the most onsets in parts of the overlap."""
    start, end = max(one.start, other.start - lag), min(one.end, other.end - lag)
    if end - start <= WINDOW_SECONDS:
        return [(start + end) / 2]
    count = min(int(2 * (end - start) / WINDOW_SECONDS), MOST_WINDOWS)
    times = np.arange(start + WINDOW_SECONDS / 2, end - WINDOW_SECONDS / 2, 0.1)
    totals = [np.concatenate([[0.0], np.cumsum(signal.values.sum(1))]) for signal in (one, other)]
    loudness = np.ones(len(times))
    for signal, total, shift in ((one, totals[0], 0.0), (other, totals[1], lag)):
        position = (times + shift - signal.start) / signal.step
        half = WINDOW_SECONDS / 2 / signal.step
        low, high = (np.clip((position + side * half).astype(int), 0, len(total) - 1) for side in (-1, 1))
        loudness *= total[high] - total[low]
    parts = np.array_split(np.arange(len(times)), min(count, len(times)) or 1)
    return [float(times[part[loudness[part].argmax()]]) for part in parts if len(part)]


def _phase_lag(one: Sound, other: Sound, middle: float, lag: float) -> float | None:
    """The lag in seconds near ``lag`` where the phases of a window agree best; None if no lag stands out."""
    from scipy.fft import irfft

    spectra = [_spectrum(one, middle), _spectrum(other, middle + lag)]
    if any(spectrum is None for spectrum in spectra):
        return None
    (first, shift_first), (second, shift_second) = (spectrum for spectrum in spectra if spectrum is not None)
    bins = min(len(first), len(second))
    hertz = np.arange(bins) / (2 * WINDOW_SECONDS)
    cross = np.conj(_whitened(first[:bins])) * _whitened(second[:bins])
    cross[(hertz < BANDS_HERTZ[0]) | (hertz > BANDS_HERTZ[-1])] = 0
    curve = np.asarray(irfft(cross, 2 * WINDOW_SECONDS * GRID_HERTZ))
    reach = round(2 * STEP_SECONDS * GRID_HERTZ)
    near = np.concatenate([curve[-reach:], curve[: reach + 1]])
    best = int(near.argmax())
    if not 0 < best < len(near) - 1 or near[best] < LEAST_STANDING_OUT * float(np.sqrt(np.mean(curve**2))):
        return None
    left, top, right = near[best - 1 : best + 2]
    vertex = (left - right) / (2 * (left - 2 * top + right))
    return lag + (best - reach + vertex) / GRID_HERTZ + shift_second - shift_first


def _whitened(spectrum: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """A spectrum divided by its smooth magnitude, so that narrow bands of noise keep their small weight."""
    from scipy.ndimage import uniform_filter1d

    magnitude = np.sqrt(uniform_filter1d(np.abs(spectrum) ** 2, SMOOTHING_BINS))
    return spectrum / np.maximum(magnitude, 1e-9 * float(magnitude.max()) + 1e-300)


def _spectrum(sound: Sound, middle: float) -> tuple[NDArray[np.complex128], float] | None:
    """Spectrum, zero padded to twice the window, and by how many seconds the window starts later than asked for."""
    from scipy.fft import rfft

    length = round(WINDOW_SECONDS * sound.rate)
    wanted = (middle - WINDOW_SECONDS / 2) * sound.rate
    first = round(wanted)
    window = np.zeros(length)
    low, high = max(first, 0), min(first + length, len(sound.samples))
    if high - low < 0.4 * length:
        return None
    window[low - first : high - first] = sound.samples[low:high]
    return np.asarray(rfft(window * np.hanning(length), 2 * length)), (first - wanted) / sound.rate
