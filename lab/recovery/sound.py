# SPDX-License-Identifier: Apache-2.0
"""What synchronisation by sound recovers of made sound, whose clocks are known: claps and noise that swells.

    python lab/recovery/sound.py

Microphones have gains over 20 dB, noise and echoes of their own. Errors are those of common times at both ends of the
take, relative to the mean of the cameras.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from structgstream.data.timeline import Clock
from structgstream.geometry import Floats
from structgstream.opus import SAMPLE_RATE
from structgstream.preparation.synchronization.audio import audio_lags, connected_by, solve_by_audio, sound_of

HERTZ = 96_000  # of the made sound
DECAY_SECONDS = 0.004  # of a clap


@dataclass(frozen=True)
class Case:
    """A take.

    Args:
        title: what is special.
        seconds: length of each recording.
        spread: within how many seconds the cameras start.
        claps: their number.
        talk: amplitude of the noise that swells.
        snr_db: of each microphone.
        reverberation: seconds in which echoes fall by 60 dB.
        drift_ppm: standard deviation of the clocks' rates.
    """

    title: str
    cameras: int = 4
    seconds: float = 20.0
    spread: float = 8.0
    claps: int = 6
    talk: float = 0.3
    snr_db: float = 10.0
    reverberation: float = 0.4
    drift_ppm: float = 0.0
    seed: int = 0


PLAIN = Case("SNR 10 dB")
SHORT = Case("two claps in 5 s, SNR 15 dB", seconds=5, spread=2, claps=2, talk=0.05, snr_db=15)
CASES = (
    *(replace(PLAIN, title=f"SNR {snr} dB", snr_db=snr) for snr in (20, 10, 0)),
    *(replace(PLAIN, title="reverberation 1 s", reverberation=1.0, seed=seed) for seed in range(3)),
    *(replace(SHORT, seed=seed) for seed in range(6)),
    Case("drift of 20 ppm", cameras=3, seconds=120, claps=20, drift_ppm=20),
    Case("14 cameras", cameras=14),
)


def main() -> None:
    for case in CASES:
        recorded, truth = made(case)
        begun = time.process_time()
        sounds = {name: sound_of(name, sound) for name, sound in recorded.items()}
        lags = audio_lags(sounds)
        takes = {name: (0.0, len(sound.samples) / SAMPLE_RATE) for name, sound in sounds.items()}
        if len(connected_by(list(takes), lags)) > 1:
            print(f"{case.title:30} not connected")
            continue
        found = solve_by_audio(takes, lags)
        clocks = {name: Clock(found.offsets[name], found.rates[name]) for name in takes}
        error = largest_error(clocks, truth, takes)
        sigma = float(np.mean(list(found.sigmas.values())))
        cpu = time.process_time() - begun
        print(f"{case.title:30} largest error {1e3 * error:.3f} ms, sigma {1e3 * sigma:.3f} ms, {cpu:.1f} CPU s")


def largest_error(
    found: Mapping[str, Clock], truth: Mapping[str, Clock], takes: Mapping[str, tuple[float, float]]
) -> float:
    """Of the common times of both ends of each take, seconds; the common clock is the first camera's."""
    first = next(iter(truth.values()))
    worst = 0.0
    for end in (0, 1):
        ends = {name: np.array(takes[name][end]) for name in takes}
        known = {name: (truth[name].common_seconds(ends[name]) - first.offset_seconds) / first.rate for name in takes}
        apart = np.array([float(found[name].common_seconds(ends[name]) - known[name]) for name in takes])
        worst = max(worst, float(np.abs(apart - apart.mean()).max()))
    return worst


def made(case: Case) -> tuple[dict[str, NDArray[np.float32]], dict[str, Clock]]:
    """What each camera records, and its clock."""
    from scipy.signal import fftconvolve

    generator = np.random.default_rng(case.seed)
    source = _source(case, generator)
    recorded, clocks = {}, {}
    for number in range(case.cameras):
        drift = 1e-6 * case.drift_ppm * generator.normal() if case.drift_ppm else 0.0
        clock = Clock(float(generator.uniform(0, case.spread)), 1 + drift)
        echoes = 0.05 * generator.normal(size=round(0.3 * HERTZ))
        echoes *= np.exp(-np.arange(len(echoes)) / HERTZ / (case.reverberation / 6.9))
        echoes[: round(0.002 * HERTZ)] = 0
        echoes[0] = 1
        heard = fftconvolve(source, echoes)[: len(source)]
        at = clock.common_seconds(np.arange(round(case.seconds * SAMPLE_RATE)) / SAMPLE_RATE) * HERTZ
        samples = np.interp(at, np.arange(len(heard)), heard) * 10 ** generator.uniform(-1, 0)
        noise = np.sqrt(np.mean(samples**2)) * 10 ** (-case.snr_db / 20)
        samples += noise * generator.normal(size=len(samples))
        recorded[f"cam{number}"], clocks[f"cam{number}"] = samples.astype(np.float32), clock
    return recorded, clocks


def _source(case: Case, generator: np.random.Generator) -> Floats:
    """The sound where it is made, from ``spread`` seconds before all cameras run."""
    total = case.seconds + 2 * case.spread
    times = np.arange(round(total * HERTZ)) / HERTZ
    source = np.zeros(len(times))
    for clap in np.sort(generator.uniform(case.spread, case.spread + case.seconds, case.claps)):  # not all hear all
        first, length = round(clap * HERTZ), round(0.03 * HERTZ)
        fading = np.exp(-np.arange(length) / HERTZ / DECAY_SECONDS)
        source[first : first + length] += 3 * generator.normal(size=length) * fading
    knots = np.arange(0, total, 0.15)
    swelling = np.maximum(np.interp(times, knots, generator.normal(size=len(knots))), 0)
    return source + case.talk * swelling * generator.normal(size=len(times))


if __name__ == "__main__":
    main()
