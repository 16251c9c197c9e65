# SPDX-License-Identifier: Apache-2.0
"""The benchmark of faults: what it counts is what happened, and in small it runs."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lab.robustness import fault_fits
from lab.robustness.fault_cameras import FILMED, Seen, State, Viewer, camera_row
from lab.robustness.fault_film import PERIOD_SECONDS, Film, Moment, film_of, pictures, read_film, write_film
from lab.robustness.fault_fits import added_up, killed_fits
from lab.robustness.fault_report import table
from lab.robustness.fault_viewers import ViewerRow, killed_servers, killed_trainers
from lab.robustness.faults import parsed
from repeated_streams import small_sent
from structgstream.frames import MultiViewFrame


def test_moments_are_those_of_the_seed_and_leave_time_for_recovering() -> None:
    for fault in FILMED:
        film = film_of(fault, moments=50, seed=3)
        assert film == film_of(fault, moments=50, seed=3)
        assert film.moments != film_of(fault, moments=50, seed=4).moments
        for camera in film.cameras:
            own = [one for one in film.moments if one.camera == camera]
            ends = [one.start + one.length for one in own]
            assert all(later.start - end > 0.3 * PERIOD_SECONDS for end, later in zip(ends, own[1:], strict=False))


def test_a_film_is_read_as_it_was_written(tmp_path: Path) -> None:
    film = film_of("cut", moments=5, seed=0, transport="rtsp", clock="arrival")
    write_film(tmp_path / "film", film)
    assert read_film(tmp_path / "film") == film


def test_what_is_smeared_and_what_is_of_another_instant_is_seen() -> None:
    film, viewer = pictures(), Viewer()
    assert [viewer.number(one) for one in film] == [*range(12)]
    smeared = film[3].copy()
    smeared[48:] = smeared[48:, ::-1] // 2
    images = {"a": film[3], "b": film[4], "c": film[3], "d": smeared}
    states = viewer.states(MultiViewFrame(0, 0.0, images), ("a", "b", "c", "d", "e"))
    assert [states[name] for name in "abcde"] == [
        State.RIGHT, State.APART, State.RIGHT, State.SMEARED, State.ABSENT,
    ]  # fmt: skip


def seen_as(text: str, *, counted_from: int) -> list[Seen]:
    """A frame each tenth of a second: camera ``a`` as the text says, ``b`` right."""
    letters = {".": State.RIGHT, "_": State.ABSENT, "s": State.SMEARED, "o": State.APART}
    return [
        Seen(100 + n / 10, {"a": letters[one], "b": State.RIGHT}, {"a": {"gone": int(n >= counted_from)}})
        for n, one in enumerate(text)
    ]


def test_a_moment_is_over_with_the_first_of_several_right_frames() -> None:
    film = Film(("a", "b"), (Moment("a", "cut", 1.0, 0.5),))
    row = camera_row(film, seen_as("." * 10 + "s___o_..__" + "." * 20, counted_from=12), begun=100.0, lost=0)
    assert (row.moments, row.frames, row.counted, row.smeared, row.apart) == (1, 40, 1, 1, 1)
    assert row.absent_frames == [6]
    assert row.seconds_until_absent == pytest.approx([0.1])
    assert row.seconds_until_normal == pytest.approx([0.5])
    assert (row.never_normal, row.others_lacking) == (0, 0)
    assert row.longest_gap_seconds == pytest.approx(0.1)


def test_what_was_not_counted_or_did_not_come_back_or_hit_another_is_seen() -> None:
    film = Film(("a", "b"), (Moment("b", "cut", 1.0, 0.5),))
    row = camera_row(film, seen_as("." * 20 + "__" + "." * 10, counted_from=99), begun=100.0, lost=2)
    assert (row.counted, row.others_lacking, row.reported_frames_lost) == (0, 2, 2)
    film = Film(("a", "b"), (Moment("a", "cut", 1.0, 0.5),))
    row = camera_row(film, seen_as("." * 10 + "_" * 20 + "...", counted_from=0), begun=100.0, lost=0)
    assert (row.never_normal, row.seconds_until_normal) == (1, [])


@pytest.mark.parametrize("killed", [partial(killed_servers, down_seconds=0.1), killed_trainers])
def test_players_go_on_after_kills(tmp_path: Path, killed: Callable[..., ViewerRow]) -> None:
    row = killed(small_sent(6), kills=2, seed=0, folder=tmp_path, players=2, page=False)
    assert (row.kills, row.equal, row.exact, row.reported_frames_lost) == (2, True, 2, 0)
    assert len(row.seconds_until_normal) == 2
    assert "| 2 of 2 |" in table({"cameras": [], "viewers": [asdict(row)]})


def test_players_go_on_where_the_trainer_is_killed_at_a_border_of_periods(tmp_path: Path) -> None:
    sent = small_sent(12, each_a_period=True)
    assert [index for index in range(1, 25) if sent.begins_period(index)] == [6, 12, 18, 24]
    row = killed_trainers(sent, kills=2, seed=1, folder=tmp_path, players=2, page=False)
    assert (row.what, row.kills, row.equal, row.exact) == ("trainer across periods", 2, True, 2)
    assert 0 <= row.borders <= 2


def test_rows_of_several_seeds_are_added_up() -> None:
    film = Film(("a", "b"), (Moment("a", "cut", 1.0, 0.5),))
    row = asdict(camera_row(film, seen_as("." * 12 + "_" * 5 + "." * 20, counted_from=12), begun=100.0, lost=0))
    text = table({"cameras": [row, {**row, "seed": 1, "smeared": 3}], "viewers": []})
    assert "| cut | 2 | 0 | 3 | 0 | 2 | 5.0 |" in text
    later = asdict(ViewerRow("server", kills=2, seed=1, frames=5, equal=True))
    earlier = {name: value for name, value in {**later, "seed": 0}.items() if name != "borders"}
    assert "| server | 4 | 10 | 0 | yes |" in table({"cameras": [], "viewers": [earlier, later]})


def test_all_is_asked_for_by_default() -> None:
    options = parsed([])
    assert set(options.only) == {*FILMED, "server", "trainer", "trainer across periods", "trainer that fits"}
    assert options.moments >= 200
    assert options.kills >= 200
    assert np.isfinite(options.down_seconds)


def test_a_series_of_streams_that_end_before_their_first_kill_ends(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(fault_fits, "Trainer", lambda work: SimpleNamespace(end=lambda signal: 0))
    monkeypatch.setattr(fault_fits, "content", lambda folder: b"")
    monkeypatch.setattr(fault_fits, "_stream", lambda *args, **options: ViewerRow("one stream", equal=True))
    with pytest.raises(RuntimeError, match="10 streams in a row .* after 0 of 3 kills"):
        killed_fits(kills=3, seed=0, folder=tmp_path, players=1, page=False)


def test_streams_of_the_trainer_that_fits_are_added_up() -> None:
    total = ViewerRow("trainer that fits", seed=3, equal=True)
    added_up(total, ViewerRow("one", kills=2, frames=12, equal=True, seconds_until_normal=[1.0, 2.0]))
    found = ViewerRow("one", kills=1, frames=12, page_went_back=[(5, 4)], page_notices={"a": 2})
    added_up(total, found)
    added_up(total, ViewerRow("one", equal=True, page_went_back=[], page_notices={"a": 1}))
    assert (total.what, total.seed, total.kills, total.frames) == ("trainer that fits", 3, 3, 24)
    assert total.seconds_until_normal == [1.0, 2.0]
    assert total.page_went_back == [(5, 4)]
    assert total.page_notices == {"a": 3}
    assert not total.equal
