# SPDX-License-Identifier: Apache-2.0
"""The configuration of later frames, and the rates that follow from it."""

import math
from dataclasses import replace

import pytest

from structgstream.errors import ConfigError
from structgstream.scene.state import PAPER_DYNAMIC, STATE_TABLE
from structgstream.session.presets import StreamConfig, from_json, to_json
from structgstream.training.online.config import ExposureConfig, OnlineConfig, OnlineRates, online_rates


def test_rates_of_anchors_and_mlps_fall_within_a_frame_and_those_of_free_gaussians_stay() -> None:
    config = OnlineConfig(rates=replace(OnlineRates(), final_share=0.25))
    first, half, last = (online_rates(config, share) for share in (0.0, 0.5, 1.0))
    assert first["anchor_positions"] == OnlineRates.ANCHOR_POSITIONS
    assert half["anchor_positions"] == pytest.approx(0.5 * first["anchor_positions"])
    assert last["anchor_positions"] == pytest.approx(0.25 * first["anchor_positions"])
    assert last["free_means"] == first["free_means"] == OnlineRates.FREE_MEANS
    assert first.keys() == {parameter.name for row in STATE_TABLE for parameter in row.parameters}


def test_the_papers_rates_are_constant() -> None:
    assert online_rates(OnlineConfig(), 0.0) == online_rates(OnlineConfig(), 1.0)


def test_a_free_colour_as_a_spherical_harmonic_moves_less_and_headers_leave_the_default_out() -> None:
    harmonic = OnlineConfig(rates=OnlineRates(free_color="sh"))
    plain, other = online_rates(OnlineConfig(), 0.0), online_rates(harmonic, 0.0)
    assert other == {**plain, "free_colors": pytest.approx(OnlineRates.FREE_COLORS * 0.5 / math.sqrt(math.pi))}
    assert "free_color" not in to_json(StreamConfig())["online"]["rates"]
    config = StreamConfig(online=harmonic)
    assert from_json(to_json(config)) == config


def test_following_the_light_needs_its_field_and_takes_it_from_the_optimiser() -> None:
    light = ExposureConfig(enabled=True)
    with pytest.raises(ConfigError, match=r"add color_mlp to online\.dynamic"):
        OnlineConfig(exposure=light)
    config = OnlineConfig(exposure=light, dynamic=PAPER_DYNAMIC.union(["color_mlp"]))
    assert config.trained == PAPER_DYNAMIC
    assert OnlineConfig().trained == PAPER_DYNAMIC
