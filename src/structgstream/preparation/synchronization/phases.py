# SPDX-License-Identifier: Apache-2.0
"""The lag of two sounds where the phases of their spectra agree (GCC-PHAT: Knapp and Carter, 1976).

Echoes agree, too: where a room is louder than the direct sound, the highest peak may be one of echoes, in all windows
alike. The height of other peaks gives the probability of that.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.preparation.synchronization.correlation import parabola_top

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
    """The lag of one window.

    Args:
        middle: its second by the first camera's clock.
        seconds: the lag where phases agree best, by the second clock minus by the first.
        curve: ``[N]`` correlation at lags up to ``REACH_SECONDS`` on both sides of ``seconds``, in units of its root
            mean square; 0 where it was not looked at.
    """

    middle: float
    seconds: float
    curve: Floats


@dataclass(frozen=True)
class Recording:
    """Mono samples ``[N]`` at ``rate`` hertz."""

    samples: NDArray[np.float32]
    rate: float


def phase_window(one: Recording, other: Recording, middle: float, lag: float) -> Window | None:
    """A window around ``middle`` of the first clock, whose lag is near ``lag``; None if no lag stands out."""
    from scipy.fft import irfft

    spectra = [_spectrum(one, middle), _spectrum(other, middle + lag)]
    if any(spectrum is None for spectrum in spectra):
        return None
    (first, shift_first), (second, shift_second) = (spectrum for spectrum in spectra if spectrum is not None)
    bins = min(len(first), len(second))
    hertz = np.arange(bins) / (2 * WINDOW_SECONDS)
    cross = np.conj(_whitened(first[:bins])) * _whitened(second[:bins])
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


def _spectrum(sound: Recording, middle: float) -> tuple[NDArray[np.complex128], float] | None:
    """Spectrum, zero padded to twice the window, and by how many seconds the window starts later than requested."""
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
