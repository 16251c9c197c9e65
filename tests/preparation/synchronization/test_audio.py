# SPDX-License-Identifier: Apache-2.0
"""Lags of made sound: echoes, gains, noise, other sample rates, drift."""

import numpy as np
import pytest

from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.audio import SPEED_OF_SOUND, audio_ties, distances_from, sound_of
from structgstream.preparation.synchronization.solving import Solution, Tie, connected, solve_clocks
from takes import heard, lenses, ring

CLOCKS = {"a": Clock(0.0), "b": Clock(1.2345), "c": Clock(0.6)}


def ties_of(clocks: dict[str, Clock], **how: object) -> list[Tie]:
    recorded = heard(clocks, **how)  # type: ignore[arg-type]
    return audio_ties({name: sound_of(name, sound) for name, sound in recorded.items()})


def solved(clocks: dict[str, Clock], *, seconds: float = 8.0, **how: object) -> Solution:
    ties = ties_of(clocks, seconds=seconds, **how)
    assert len(connected(list(clocks), ties)) == 1
    return solve_clocks(dict.fromkeys(clocks, (0.0, seconds)), ties, drift=True, slack_seconds=0.02)


@pytest.mark.parametrize(("snr_db", "echo"), [(20.0, 0.03), (10.0, 0.03), (0.0, 0.0)])
def test_offsets_below_a_tenth_of_a_millisecond(snr_db: float, echo: float) -> None:
    solution = solved(CLOCKS, snr_db=snr_db, echo=echo, rates=(44100, 48000))
    for name, clock in CLOCKS.items():
        error = solution.offsets[name] - clock.offset_seconds
        assert abs(error) < 1e-4
        assert abs(error) < 3 * (solution.sigmas[name] + solution.sigmas["a"])


def test_noise_makes_it_coarse_not_wrong() -> None:
    solution = solved(CLOCKS, snr_db=0.0, echo=0.03, seed=3)
    for name, clock in CLOCKS.items():
        assert abs(solution.offsets[name] - clock.offset_seconds) < 3 * (solution.sigmas[name] + solution.sigmas["a"])
        assert solution.sigmas[name] < 5e-3


def test_drift_of_a_long_take() -> None:
    clocks = {"a": Clock(0.0), "b": Clock(0.7, 1 + 40e-6)}
    solution = solved(clocks, seconds=60.0, snr_db=15.0, rates=(16000,))
    assert solution.rates["b"] - 1 == pytest.approx(40e-6, abs=4e-6)
    assert solution.offsets["b"] == pytest.approx(0.7, abs=3e-4)


def test_known_distances_are_taken_out() -> None:
    distances = {"a": 1.0, "b": 4.0, "c": 2.0}
    delays = {name: metres / SPEED_OF_SOUND for name, metres in distances.items()}
    recorded = heard(CLOCKS, delays=delays, snr_db=20.0)
    sounds = {name: sound_of(name, sound) for name, sound in recorded.items()}
    takes = dict.fromkeys(CLOCKS, (0.0, 8.0))
    biased, right = (
        solve_clocks(takes, audio_ties(sounds, distances=known), drift=False, slack_seconds=0.02)
        for known in (None, distances)
    )
    assert right.offsets["b"] == pytest.approx(1.2345, abs=1e-4)
    assert biased.offsets["b"] == pytest.approx(1.2345 - 3 / SPEED_OF_SOUND, abs=1e-4)


def test_distances_are_those_of_the_lenses() -> None:
    distances = distances_from(np.array([0.0, -0.4, 0.0]), lenses(ring(3)))
    assert distances["cam0"] == pytest.approx(3.0)
    assert distances["cam1"] == pytest.approx(np.hypot(3.0, 0.5))


def test_different_sounds_have_no_ties() -> None:
    one = heard({"a": Clock()}, seed=1)["a"]
    other = heard({"b": Clock()}, seed=2)["b"]
    sounds = {name: sound_of(name, sound) for name, sound in (("a", one), ("b", other))}
    assert audio_ties(sounds) == []


def test_silence_and_short_sound() -> None:
    with pytest.raises(CaptureError, match=r"sound of camera 'a' is silence"):
        sound_of("a", (np.zeros(48000, np.float32), 48000.0))
    with pytest.raises(CaptureError, match=r"Camera 'a' has 0.50 s of sound"):
        sound_of("a", (np.ones(24000, np.float32), 48000.0))
