# SPDX-License-Identifier: Apache-2.0
"""Lags of made sound: echoes, gains, noise, drift; phases of windows, and loops that close."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.opus import SAMPLE_RATE
from structgstream.preparation.synchronization.audio import (
    GRID_HERTZ,
    OTHER_SECONDS,
    REACH_SECONDS,
    PairLag,
    Sound,
    Window,
    ambiguity_seconds,
    ambiguity_weights,
    audio_lags,
    connected_by,
    phase_window,
    solve_by_audio,
    sound_of,
)
from structgstream.preparation.synchronization.solving import Solution
from tests.support.properties import examples
from tests.support.takes import heard

CLOCKS = {"a": Clock(0.0), "b": Clock(1.2345), "c": Clock(0.6)}


def lags_of(clocks: dict[str, Clock], **how: object) -> list[PairLag]:
    recorded = heard(clocks, **how)  # type: ignore[arg-type]
    return audio_lags({name: sound_of(name, sound) for name, sound in recorded.items()})


def solved(clocks: dict[str, Clock], *, seconds: float = 8.0, **how: object) -> Solution:
    lags = lags_of(clocks, seconds=seconds, **how)
    assert len(connected_by(list(clocks), lags)) == 1
    return solve_by_audio(dict.fromkeys(clocks, (0.0, seconds)), lags)


@pytest.mark.parametrize(("snr_db", "echo"), [(20.0, 0.03), (10.0, 0.03), (0.0, 0.0)])
def test_offsets_below_a_tenth_of_a_millisecond(snr_db: float, echo: float) -> None:
    solution = solved(CLOCKS, snr_db=snr_db, echo=echo)
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
    solution = solved(clocks, seconds=60.0, snr_db=15.0)
    assert solution.rates["b"] - 1 == pytest.approx(40e-6, abs=4e-6)
    assert solution.offsets["b"] == pytest.approx(0.7, abs=3e-4)


def test_different_sounds_have_no_ties() -> None:
    one = heard({"a": Clock()}, seed=1)["a"]
    other = heard({"b": Clock()}, seed=2)["b"]
    sounds = {name: sound_of(name, sound) for name, sound in (("a", one), ("b", other))}
    assert audio_lags(sounds) == []


def test_silence_and_short_sound() -> None:
    with pytest.raises(CaptureError, match=r"sound of camera 'a' is silence"):
        sound_of("a", np.zeros(48000, np.float32))
    with pytest.raises(CaptureError, match=r"Camera 'a' has 0.50 s of sound"):
        sound_of("a", np.ones(24000, np.float32))


def claps(
    clocks: dict[str, Clock], travels: list[dict[str, float]], *, at: list[float], seed: int = 0
) -> dict[str, Sound]:
    """Claps of several places in 5 s: the seconds that each needs to each camera."""
    generator = np.random.default_rng(seed)
    burst = generator.normal(size=2400) * np.exp(-np.arange(2400) / 400)
    sounds = {}
    for name, clock in clocks.items():
        samples = generator.normal(0, 0.004, 5 * 48000)
        for common, ways in zip(at, travels, strict=True):
            first = round((common + ways[name] - clock.offset_seconds) * 48000)
            samples[first : first + 2400] += 0.3 * burst
        sounds[name] = sound_of(name, samples.astype(np.float32))
    return sounds


PLACES = [
    {"a": 0.002, "b": 0.006, "c": 0.004},
    {"a": 0.006, "b": 0.002, "c": 0.003},
    {"a": 0.003, "b": 0.004, "c": 0.006},
]
STARTS = {"a": Clock(0.0), "b": Clock(0.35), "c": Clock(0.2)}


def test_claps_from_several_places_are_one_lag() -> None:
    """Their lags differ by up to 8 ms; the lag at which all agree is near the mean, and what is stated covers it."""
    lags = audio_lags(claps(STARTS, PLACES, at=[1.3, 2.2, 4.0]))
    assert len(lags) == 3
    solution = solve_by_audio(dict.fromkeys(STARTS, (0.0, 5.0)), lags)
    for name, clock in STARTS.items():
        assert abs(solution.offsets[name] - clock.offset_seconds) < 4e-3
        assert abs(solution.offsets[name] - clock.offset_seconds) < 2 * solution.sigmas[name]


def test_a_clap_that_agrees_with_another_clap_is_refused() -> None:
    """Each camera hears three claps of its own: any clap of one fits any of another."""
    one = claps({"a": STARTS["a"]}, PLACES, at=[1.0, 2.0, 4.1])
    other = claps({"b": STARTS["b"]}, PLACES, at=[0.9, 2.6, 3.1], seed=0)
    assert audio_lags({**one, **other}) == []


@pytest.mark.parametrize("at", [[], [2.2]])
def test_cameras_that_beep_when_they_start_and_stop_did_not_start_at_once(at: list[float]) -> None:
    """What each hears of itself agrees at no lag at all, be there a clap that all hear or nothing."""
    beep = 0.5 * np.sin(2 * np.pi * 2000 / 48000 * np.arange(6000))
    sounds = {}
    for name, sound in claps(STARTS, PLACES[: len(at)], at=at).items():
        samples = sound.samples.copy()
        for second in (0.1, 0.3, 4.7):
            samples[round(second * 48000) :][: len(beep)] += beep
        sounds[name] = sound_of(name, samples)
    for lag in audio_lags(sounds):
        apart = STARTS[lag.first].offset_seconds - STARTS[lag.second].offset_seconds
        assert lag.at(0.0) == pytest.approx(apart, abs=0.01)


def test_a_room_that_is_louder_than_the_direct_sound_is_uncertain() -> None:
    """Echoes make peaks that all windows agree on; how high others are tells."""
    scores = []
    for seed in range(4):
        lags = lags_of(CLOCKS, seconds=8.0, snr_db=10.0, echo=0.15, seed=seed)
        if len(connected_by(list(CLOCKS), lags)) > 1:
            continue
        solution = solve_by_audio(dict.fromkeys(CLOCKS, (0.0, 8.0)), lags)
        errors = np.array([solution.offsets[name] - clock.offset_seconds for name, clock in CLOCKS.items()])
        scores += list((errors - errors.mean()) / np.array(list(solution.sigmas.values())))
    assert len(scores) >= 6
    assert np.abs(scores).max() < 3


BEGAN = {"a": 0.0, "b": 1.2, "c": -0.4, "d": 2.5}


def lag_of(first: str, second: str, *, off: float = 0.0, rate: float = 0.0, fine: bool = True) -> PairLag:
    apart = BEGAN[first] - BEGAN[second] + off
    instants = tuple((at, apart + rate * at) for at in (2.0, 5.0, 9.0))
    return PairLag(first, second, instants, 1e-4, 2e-3, 1.0, fine)


@pytest.mark.parametrize("turned", [False, True])
def test_a_loop_that_closes_leaves_less(turned: bool) -> None:
    last = lag_of("c", "a") if turned else lag_of("a", "c")
    lags = [lag_of("a", "b"), lag_of("b", "c"), last, lag_of("c", "d")]
    assert ambiguity_weights(lags) == pytest.approx([1 / 3, 1 / 3, 1 / 3, 1])


def test_a_loop_that_does_not_close_leaves_all_doubt() -> None:
    assert ambiguity_weights([lag_of("a", "b"), lag_of("b", "c"), lag_of("a", "c", off=2e-3)]) == [1, 1, 1]
    assert ambiguity_weights([lag_of("a", "b"), lag_of("b", "c"), lag_of("a", "c", fine=False)]) == [1, 1, 1]


def test_loops_that_share_a_pair_support_each_other() -> None:
    pairs = [lag_of("a", "b"), lag_of("b", "c"), lag_of("a", "c"), lag_of("b", "d"), lag_of("c", "d")]
    assert ambiguity_weights(pairs) == pytest.approx([1 / 9] * 5)


def test_drift_does_not_open_a_loop() -> None:
    """Lags of c change by 1e-4 a second: 0.25 ms in the time by which clocks differ, 0.9 ms in the take."""
    lags = [lag_of("a", "b"), lag_of("b", "c", rate=1e-4), lag_of("a", "c", rate=1e-4)]
    assert ambiguity_weights(lags) == pytest.approx([1 / 3] * 3)


LONG = 6.0
REACH = round(REACH_SECONDS * GRID_HERTZ)


def noise(seed: int = 0, seconds: float = LONG) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=round(seconds * SAMPLE_RATE)).astype(np.float32)


def delayed(lag: float, *, gain: float = 1.0, snr: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """A sound, and the same one later by ``lag`` seconds with noise of its own, at another gain."""
    sound = noise()
    times = np.arange(len(sound)) / SAMPLE_RATE
    late = np.interp(times - lag, times, sound)
    late += np.random.default_rng(9).normal(size=len(times)) / snr
    return sound, (gain * late).astype(np.float32)


@pytest.mark.parametrize("lag", [0.0, 0.0031, -0.5, 1.2345678])
def test_the_lag_is_found_within_a_part_of_a_sample(lag: float) -> None:
    found = phase_window(*delayed(lag, gain=0.02), 3.0, lag + 0.002)
    assert found is not None
    assert found.seconds == pytest.approx(lag, abs=3e-6)
    assert found.middle == 3.0


def test_the_expectation_does_not_move_the_answer() -> None:
    answers = [phase_window(*delayed(0.25), 3.0, 0.25 + off) for off in (-0.006, -0.001, 0.0, 0.004)]
    assert np.ptp([one.seconds for one in answers if one is not None]) < 2e-6
    assert None not in answers


def test_beyond_its_reach_nothing_stands_out() -> None:
    assert phase_window(*delayed(0.25), 3.0, 0.25 + 2 * REACH_SECONDS) is None
    one, _ = delayed(0.0)
    assert phase_window(one, noise(5), 3.0, 0.0) is None


def test_silence_and_the_ends_of_a_recording_tell_nothing() -> None:
    one, other = delayed(0.0)
    assert phase_window(one, np.zeros_like(other), 3.0, 0.0) is None
    assert phase_window(one, other, 3.0, 0.0) is not None
    assert phase_window(one, other, 0.5, 0.0) is not None  # three quarters of the window are there
    for middle in (-0.3, LONG + 0.3, 50.0):
        assert phase_window(one, other, middle, 0.0) is None


def test_the_curve_has_its_peak_in_the_middle() -> None:
    found = phase_window(*delayed(0.25), 3.0, 0.253)
    assert found is not None
    assert len(found.curve) == 2 * REACH + 1
    assert abs(int(found.curve.argmax()) - REACH) <= 1


def curve(*peaks: tuple[float, float]) -> np.ndarray:
    """Narrow peaks of a height at a distance in seconds from the middle."""
    found = np.zeros(2 * REACH + 1)
    for seconds, height in peaks:
        found[REACH + round(seconds * GRID_HERTZ)] = height
    return found


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([], 0.0),
        ([(0.8 * OTHER_SECONDS, 19.0)], 0.0),
        ([(0.004, 20.0)], 0.004 / np.sqrt(2)),
        ([(0.004, 10.0)], 0.004 * np.sqrt(1 / 65)),
    ],
)
def test_one_peak_is_sure_and_an_equal_one_as_likely(others: list[tuple[float, float]], expected: float) -> None:
    found = ambiguity_seconds([Window(0.0, 0.0, curve((0.0, 20.0), *others))])
    assert found == pytest.approx(expected, rel=1e-6, abs=0)


@given(st.lists(st.tuples(st.floats(-0.0075, 0.0075), st.floats(0.0, 20.0)), max_size=5))
@examples(100)
def test_the_uncertainty_is_within_reach_and_windows_that_differ_lower_it(others: list[tuple[float, float]]) -> None:
    one = Window(0.0, 0.0, curve(*others, (0.0, 20.0)))
    alone = ambiguity_seconds([one])
    assert 0.0 <= alone <= REACH_SECONDS
    assert ambiguity_seconds([one, Window(1.0, 0.0, curve((0.0, 20.0)))]) <= alone + 1e-12
    assert ambiguity_seconds([one, one]) == pytest.approx(alone)
