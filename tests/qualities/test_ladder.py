# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest

from structgstream.errors import ConfigError
from structgstream.qualities import Quality, configured, qualities_in
from structgstream.session.presets import PRESETS


def test_the_coarsest_comes_first() -> None:
    assert qualities_in(["high=1", "low=-1.5", "mid=0"]) == (
        Quality("low", -1.5),
        Quality("mid", 0),
        Quality("high", 1),
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["low=1"], "2 to 8 qualities, .* got 1; for a single one give --quality"),
        ([f"q{n}={n / 4}" for n in range(9)], "2 to 8 qualities, .* got 9"),
        (["low", "high=1"], "low is no quality; expected NAME=Q"),
        (["low=x", "high=1"], "low=x is no quality"),
        (["low=1=2", "high=1"], "low=1=2 is no quality"),
        (["=1", "high=1"], "=1 is no quality"),
        (["a.b=1", "high=2"], "a.b=1 is no quality"),
        (["low=-7", "high=1"], "a Q from -6 to 6"),
        (["low=nan", "high=1"], "low=nan is no quality"),
        (["low=1", "low=2"], "has the name low twice"),
        (["low=1", "Low=2"], "has the name low twice"),
        (["low=1", "high=1.0"], "has the Q 1 twice"),
    ],
)
def test_what_is_no_ladder_is_refused(given: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        qualities_in(given)


def test_a_quality_is_the_knob_and_nothing_else() -> None:
    config = PRESETS["tiny"]
    found = configured(config, Quality("low", -1.5))
    assert found.online.rounding.quality == -1.5
    rounding = replace(found.online.rounding, quality=config.online.rounding.quality)
    assert replace(found, online=replace(found.online, rounding=rounding)) == config
    with pytest.raises(ConfigError, match="got the codec raw; add --preset compact"):
        configured(PRESETS["rig"], Quality("low", -1.5))
