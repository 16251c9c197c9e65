# SPDX-License-Identifier: Apache-2.0
"""Instants that pairs of cameras share, from what their microphones hear.

Coarse: increases of energy in a few bands (onsets) are correlated over all lags; levels and tone of microphones do not
matter. Onsets are smoothed, so that sounds from several places agree on one lag. Fine: in windows with many onsets the
phases of spectra are compared (GCC-PHAT: Knapp and Carter, 1976). Windows that agree give the lag; where they do not,
because each picks up another source, the coarse one is taken.

Sound needs 2.9 ms a metre. Where a room is louder than the direct sound, the highest peak may be one of echoes, in all
windows alike: what the other peaks of a pair leave open is part of its error, less so where lags close loops of three
cameras, which wrong ones do only by chance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from structgstream.data.matching import Pair, connected_groups
from structgstream.errors import CaptureError
from structgstream.geometry import Floats
from structgstream.opus import SAMPLE_RATE
from structgstream.preparation.synchronization.correlation import Signal, best_lag, parabola_top
from structgstream.preparation.synchronization.solving import Solution, TimeCorrespondence, solve_clocks

Samples = NDArray[np.float32]
"""Mono ``[N]`` at ``SAMPLE_RATE``."""

WINDOW_SECONDS = 2
LOW_HERTZ, HIGH_HERTZ = 150.0, 8000.0
GRID_HERTZ = 96000  # of the correlation
REACH_SECONDS = 0.008  # on both sides of the expected lag
MIN_STANDING_OUT = 6.0  # of a peak, over the root mean square of the correlation
SMOOTHING_BINS = 101  # over which spectra are made white
OTHER_SECONDS = 3e-4  # from the best peak, from where on a peak is another one
RIVAL_POWER = 6  # of a peak's share of the best one: how likely it is the right one instead


@dataclass(frozen=True)
class Window:
    """The lag of one window."""

    middle: float  # its second by the first camera's clock
    seconds: float  # the lag where phases agree best, by the second clock minus by the first
    curve: Floats
    """``[N]`` correlation at lags up to ``REACH_SECONDS`` on both sides of ``seconds``, in units of its root mean
    square; 0 where it was not looked at."""


def phase_window(one: Samples, other: Samples, middle: float, lag: float) -> Window | None:
    """A window around ``middle`` of the first clock, whose lag is near ``lag``; None if no lag stands out."""
    from scipy.fft import irfft

    spectra = [_spectrum(one, middle), _spectrum(other, middle + lag)]
    if any(spectrum is None for spectrum in spectra):
        return None
    (first, shift_first), (second, shift_second) = (spectrum for spectrum in spectra if spectrum is not None)
    hertz = np.arange(len(first)) / (2 * WINDOW_SECONDS)
    cross = np.conj(_whitened(first)) * _whitened(second)
    cross[(hertz < LOW_HERTZ) | (hertz > HIGH_HERTZ)] = 0
    curve = np.asarray(irfft(cross, 2 * WINDOW_SECONDS * GRID_HERTZ))
    level = float(np.sqrt(np.mean(curve**2)))
    if not level > 0:  # a microphone that was silent
        return None
    reach = round(REACH_SECONDS * GRID_HERTZ)
    near = np.concatenate([curve[-reach:], curve[: reach + 1]]) / level
    best = int(near.argmax())
    if not 0 < best < len(near) - 1 or near[best] < MIN_STANDING_OUT:
        return None
    vertex = float(parabola_top(*near[best - 1 : best + 2], flat=0.0))
    seconds = lag + (best - reach + vertex) / GRID_HERTZ + shift_second - shift_first
    moved = np.zeros_like(near)
    low, high = max(0, best - reach), min(len(near), best + reach + 1)
    moved[low - best + reach : high - best + reach] = near[low:high]
    return Window(middle, seconds, moved)


def ambiguity_seconds(windows: list[Window]) -> float:
    """Standard deviation of the lag that windows agree on, by the other peaks of the sum of their curves.

    The probability of each peak is a power of its height relative to the best one.
    """
    total = np.sum([window.curve for window in windows], axis=0)
    middle = len(total) // 2
    tops = np.flatnonzero((total[1:-1] > total[:-2]) & (total[1:-1] >= total[2:])) + 1
    away = (tops - middle) / GRID_HERTZ
    tops, away = tops[np.abs(away) > OTHER_SECONDS], away[np.abs(away) > OTHER_SECONDS]
    weights = np.clip(total[tops] / total[middle], 0, 1) ** RIVAL_POWER
    return float(np.sqrt(np.sum(weights * away**2) / (1 + weights.sum())))


def _whitened(spectrum: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """A spectrum divided by its smooth magnitude, so that narrow bands of noise keep their small weight."""
    from scipy.ndimage import uniform_filter1d

    magnitude = np.sqrt(uniform_filter1d(np.abs(spectrum) ** 2, SMOOTHING_BINS))
    return spectrum / np.maximum(magnitude, 1e-9 * float(magnitude.max()) + 1e-300)


def _spectrum(samples: Samples, middle: float) -> tuple[NDArray[np.complex128], float] | None:
    """Spectrum, zero padded to twice the window, and by how many seconds the window starts later than requested."""
    from scipy.fft import rfft

    length = WINDOW_SECONDS * SAMPLE_RATE
    wanted = (middle - WINDOW_SECONDS / 2) * SAMPLE_RATE
    first = round(wanted)
    window = np.zeros(length)
    low, high = max(first, 0), min(first + length, len(samples))
    if high - low < 0.4 * length:
        return None
    window[low - first : high - first] = samples[low:high]
    return np.asarray(rfft(window * np.hanning(length), 2 * length)), (first - wanted) / SAMPLE_RATE


CLOSING_SECONDS = 3e-4  # by which the lags of a loop may miss each other
LOOP_WEIGHT = 1 / 3  # that a closed loop leaves: its lags, if wrong, would be spread over several milliseconds
MAX_LOOPS = 3
SPEED_OF_SOUND = 343.0  # metres a second, at 20 degrees Celsius
STEP_SECONDS = 0.004  # of onsets
OWN_SECONDS, OWN_SHARE = 0.5, 0.1
"""At both ends of a take, at most this share of it: there cameras hear themselves beep that they start or stop."""
SMOOTHING_STEPS = 1.0  # standard deviation; ways of sound that differ by a metre are apart by less than a step
BANDS_HERTZ = (LOW_HERTZ, 600.0, 1500.0, 3500.0, HIGH_HERTZ)
MIN_OVERLAP_SECONDS = 1.0
RIVAL_RATIO = 0.8  # of the second best lag to the best one
SINGLE_RIVAL_RATIO = 0.5  # the same where one bang alone agrees, which any other may do
SEVERAL_SHARE, SEVERAL_SECONDS = 0.3, 0.15  # of a second bang: its share of the first one, and its distance
CHANCE_DEVIATIONS = 7.0  # that a coarse peak exceeds: the largest of 300000 normal numbers is at 4.5
COARSE_SIGMA_SECONDS = 2.5e-3  # of a lag by onsets: claps from several places, echoes
MAX_WINDOWS = 16
SLACK_SECONDS = 0.02  # what drift may make of a lag before rates are known
FINE_SIGMA_SECONDS = 1e-4  # of a window's peak in a room that echoes
AGREEING_SECONDS, MAX_DRIFT = 1.5e-4, 2e-4  # between windows
MIN_AGREEING, MIN_AGREEING_SHARE = 4, 0.4
STRIDES = (1, 2, 3, 5)  # between partners, where there are more cameras than the next number
ALL_PAIRS = 12


@dataclass(frozen=True)
class PairLag:
    """What is known of the clocks of two cameras."""

    first: str  # name of a camera
    second: str  # name of another
    instants: tuple[tuple[float, float], ...]
    """Seconds by the first camera's clock, and the lag there: the second camera's second minus that."""
    sigma_seconds: float  # standard error of each lag
    ambiguity_seconds: float  # standard error that all of them share, because another peak may be the right one
    confidence: float  # how distinct it is
    fine: bool = True  # whether the lag comes from phases, so that loops close

    def at(self, seconds: float) -> float:
        """The second camera's second at a second of the first camera's, by a line through the lags."""
        times, lags = np.array(self.instants).T
        spread = times - times.mean()
        slope = float(spread @ lags / (spread @ spread)) if np.ptp(times) > 0 else 0.0
        return seconds + float(lags.mean()) + slope * (seconds - float(times.mean()))

    @property
    def middle(self) -> float:
        """The mean of the instants by the first camera's clock."""
        return float(np.mean([at for at, _ in self.instants]))


def ambiguity_weights(lags: Sequence[PairLag]) -> list[float]:
    """For each pair the share of its ambiguity that closed loops leave, 1 where there is none.

    Loops that share a pair support each other, so their number is that of all that hang together.
    """
    known = {(lag.first, lag.second): lag for lag in lags if lag.fine}
    names = list(dict.fromkeys(name for pair in known for name in pair))
    groups: list[tuple[set[tuple[str, str]], int]] = []
    for three in combinations(names, 3):
        sides = [(a, b) if (a, b) in known else (b, a) for a, b in combinations(three, 2)]
        if any(side not in known for side in sides) or not _closes(three, known):
            continue
        joined, count = set(sides), 1
        for group in [group for group in groups if group[0] & joined]:
            groups.remove(group)
            joined, count = joined | group[0], count + group[1]
        groups.append((joined, count))
    loops = {pair: count for pairs, count in groups for pair in pairs}
    return [LOOP_WEIGHT ** min(loops.get((lag.first, lag.second), 0), MAX_LOOPS) for lag in lags]


def _closes(three: Sequence[str], known: dict[tuple[str, str], PairLag]) -> bool:
    """Whether the same instant by the third camera comes out by both ways."""
    a, b, c = three
    start = known[a, b].middle if (a, b) in known else known[b, a].at(known[b, a].middle)
    return abs(_mapped(known, b, c, _mapped(known, a, b, start)) - _mapped(known, a, c, start)) < CLOSING_SECONDS


def _mapped(known: dict[tuple[str, str], PairLag], first: str, second: str, seconds: float) -> float:
    if (first, second) in known:
        return known[first, second].at(seconds)
    lag = known[second, first]
    near = 2 * seconds - lag.at(seconds)
    return near + seconds - lag.at(near)


@dataclass(frozen=True)
class Sound:
    """A recording and its onsets."""

    samples: Samples
    onsets: Signal


class UnusableSoundError(CaptureError):
    """The sound of cameras cannot synchronise them; ``reason`` is a sentence without its full stop, ``remedy`` its
    rest."""

    def __init__(self, reason: str, remedy: str) -> None:
        super().__init__(f"{reason}; {remedy}.")
        self.reason = reason


def sound_of(name: str, samples: Samples) -> Sound:
    """What camera ``name`` recorded; silence, or less than a second, is an :class:`UnusableSoundError`."""
    if len(samples) < MIN_OVERLAP_SECONDS * SAMPLE_RATE:
        raise UnusableSoundError(
            f"Camera {name!r} has {len(samples) / SAMPLE_RATE:.2f} s of sound, less than the {MIN_OVERLAP_SECONDS:g} s "
            "that can be compared",
            "synchronise by motion or timestamps.csv",
        )
    if not np.ptp(samples) > 0:
        raise UnusableSoundError(
            f"The sound of camera {name!r} is silence",
            "switch its microphone on, or synchronise by motion or timestamps.csv",
        )
    return Sound(samples, _onsets(samples))


def audio_lags(sounds: Mapping[str, Sound]) -> list[PairLag]:
    """Lags of the pairs of cameras that hear the same; pairs whose best lag is ambiguous have none."""
    return [lag for pair in _pairs(list(sounds)) if (lag := _pair_lag(*pair, sounds)) is not None]


def solve_by_audio(takes: Mapping[str, tuple[float, float]], lags: Sequence[PairLag]) -> Solution:
    """Clocks by sound.

    Args:
        takes: camera to the first and last second of its take.
        lags: what :func:`audio_lags` gives; they must connect all cameras (:func:`connected_by`).
    """
    # A wrong peak is off by as much in all windows of a pair: drift is estimated from windows, offsets from pairs.
    sharp = solve_clocks(takes, _matches(lags, [0.0] * len(lags)), drift=True, slack_seconds=SLACK_SECONDS)
    rates = sharp.rates
    matches = [
        replace(
            match,
            first_seconds=rates[match.first] * match.first_seconds,
            second_seconds=rates[match.second] * match.second_seconds,
        )
        for match in _matches(lags, ambiguity_weights(lags))
    ]
    spans = {name: (rates[name] * start, rates[name] * end) for name, (start, end) in takes.items()}
    found = solve_clocks(spans, matches, drift=False, slack_seconds=SLACK_SECONDS)
    sigmas = {name: float(np.hypot(found.sigmas[name], sharp.sigmas[name])) for name in takes}
    return replace(found, rates=rates, sigmas=sigmas)


def connected_by(cameras: Sequence[str], lags: Sequence[PairLag]) -> list[tuple[str, ...]]:
    """Groups of cameras that lags connect, the largest first."""
    return connected_groups(cameras, [(lag.first, lag.second) for lag in lags])


def _pairs(names: list[str]) -> list[Pair]:
    if len(names) <= ALL_PAIRS:
        return list(combinations(names, 2))
    return [(names[i], names[(i + stride) % len(names)]) for stride in STRIDES for i in range(len(names))]


def _pair_lag(first: str, second: str, sounds: Mapping[str, Sound]) -> PairLag | None:
    one, other = sounds[first], sounds[second]
    min_overlap = round(MIN_OVERLAP_SECONDS / STEP_SECONDS)
    coarse = best_lag(one.onsets, other.onsets, min_overlap=min_overlap)
    # The right lag is the one at which all sounds agree; another one has a clap agree with another clap.
    if coarse is None or coarse.rival > RIVAL_RATIO * coarse.judged:
        return None
    if coarse.judged < CHANCE_DEVIATIONS * coarse.deviation:
        return None
    confidence = coarse.judged / max(coarse.rival, 0.01)
    found = [
        window
        for middle in _windows(one.onsets, other.onsets, coarse.seconds)
        if (window := phase_window(one.samples, other.samples, middle, coarse.seconds)) is not None
    ]
    agreeing = _on_a_line(found)
    if not agreeing:
        if coarse.rival > SINGLE_RIVAL_RATIO * coarse.judged and not _several(one.onsets, other.onsets, coarse.seconds):
            return None
        whole = ((coarse.middle, coarse.seconds),)
        return PairLag(first, second, whole, COARSE_SIGMA_SECONDS, COARSE_SIGMA_SECONDS, confidence / 4, fine=False)
    instants = tuple((window.middle, window.seconds) for window in agreeing)
    return PairLag(first, second, instants, FINE_SIGMA_SECONDS, ambiguity_seconds(agreeing), confidence)


def _several(one: Signal, other: Signal, lag: float) -> bool:
    """Whether more than one bang of both agrees at a lag."""
    times = np.arange(max(one.start, other.start - lag), min(one.end, other.end - lag), one.step)
    both = np.zeros(len(times))
    for x, y in zip(one.values.T, other.values.T, strict=True):
        at_one = one.start + one.step * np.arange(len(x)), other.start - lag + other.step * np.arange(len(y))
        both += np.interp(times, at_one[0], x) * np.interp(times, at_one[1], y)
    first = int(both.argmax())
    elsewhere = np.abs(times - times[first]) > SEVERAL_SECONDS
    return bool(elsewhere.any()) and float(both[elsewhere].max()) > SEVERAL_SHARE * float(both[first])


def _matches(lags: Sequence[PairLag], weights: Sequence[float]) -> list[TimeCorrespondence]:
    """Correspondences with the errors of windows and the ``weights`` share of the error that all windows of a pair have
    in common because another peak may be the right one."""
    matches = []
    for lag, weight in zip(lags, weights, strict=True):
        shared = lag.ambiguity_seconds * weight * len(lag.instants) ** 0.5 if lag.fine else 0.0
        sigma = float(np.hypot(lag.sigma_seconds, shared))
        matches += [
            TimeCorrespondence(lag.first, lag.second, at, at + seconds, sigma, lag.confidence)
            for at, seconds in lag.instants
        ]
    return matches


def _on_a_line(found: list[Window]) -> list[Window]:
    """The windows that agree with most others on a lag and a drift; none if too few do.

    Echoes and noise give lags that are spread over the range that is searched, so a few that agree are right.
    """
    if len(found) < MIN_AGREEING:
        return []
    times = np.array([window.middle for window in found])
    lags = np.array([window.seconds for window in found])
    best = np.zeros(len(found), bool)
    for i, j in combinations(range(len(found)), 2):
        slope = (lags[j] - lags[i]) / (times[j] - times[i]) if times[i] != times[j] else np.inf
        for drift in (0.0, slope):
            if abs(drift) <= MAX_DRIFT:
                on = np.abs(lags - lags[i] - drift * (times - times[i])) < AGREEING_SECONDS
                best = on if on.sum() > best.sum() else best
    if best.sum() < max(MIN_AGREEING, MIN_AGREEING_SHARE * len(found)):
        return []
    return [window for window, agrees in zip(found, best, strict=True) if agrees]


def _onsets(samples: Samples) -> Signal:
    """Smoothed increases ``[T, B]`` of the logarithm of the energy in each band, above the band's usual energy; none at
    the ends of the take, where the sounds of cameras themselves would say that all started at once."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import butter, sosfilt

    count = int(len(samples) / SAMPLE_RATE / STEP_SECONDS)
    bounds = np.rint(np.arange(count + 1) * STEP_SECONDS * SAMPLE_RATE).astype(int)
    channels = []
    for low, high in pairwise(BANDS_HERTZ):
        filter_ = butter(2, (low, high), "bandpass", fs=SAMPLE_RATE, output="sos")
        power = np.asarray(sosfilt(filter_, samples)) ** 2
        energy = np.add.reduceat(power, bounds[:-1])[:count] / np.diff(bounds)
        level = np.log(energy + max(float(np.median(energy)), 1e-12 * float(energy.max()), 1e-30))
        channels.append(np.maximum(np.diff(level, prepend=level[0]), 0.0))
    onsets = gaussian_filter1d(np.stack(channels, axis=1), SMOOTHING_STEPS, axis=0)
    own = round(min(OWN_SECONDS, OWN_SHARE * count * STEP_SECONDS) / STEP_SECONDS)
    onsets[:own] = onsets[count - own :] = 0.0
    return Signal(onsets, STEP_SECONDS / 2, STEP_SECONDS)


def _windows(one: Signal, other: Signal, lag: float) -> list[float]:
    """Middles, by the first camera's clock, of the windows with the most onsets in parts of the overlap."""
    start, end = max(one.start, other.start - lag), min(one.end, other.end - lag)
    if end - start <= WINDOW_SECONDS:
        return [(start + end) / 2]
    count = min(int(2 * (end - start) / WINDOW_SECONDS), MAX_WINDOWS)
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
