# SPDX-License-Identifier: Apache-2.0
import random

import pytest

from structgstream.codec.packets import PacketKind
from structgstream.errors import ConfigError
from structgstream.rate_control import LEAST, MOST, RateConfig, RateController, pressed
from structgstream.training.online import OnlineConfig

FPS, KEY_EVERY = 30.0, 30


def simulated(target_mbits: float, *, exponent: float, frames: int = 150) -> list[int]:
    """Packets of a scene that moves 1.6 times as much from frame 70 on; bytes fall with ``pressure ** -exponent``."""
    controller, noise = RateController(RateConfig(target_mbits), FPS), random.Random(0)
    sizes: list[int] = []
    for index in range(frames):
        key = index % KEY_EVERY == 0
        delta = 14e3 * (1.6 if index > 70 else 1.0) * controller.pressure**-exponent * noise.uniform(0.85, 1.15)
        sizes.append(int((60e3 if index else 300) if key else delta))
        controller.add(sizes[-1], PacketKind.KEY if key else PacketKind.DELTA)
    return sizes


@pytest.mark.parametrize("exponent", [0.33, 0.6])
@pytest.mark.parametrize("target_mbits", [2.4, 3.6])
def test_every_window_keeps_to_the_target(target_mbits: float, exponent: float) -> None:
    sizes = simulated(target_mbits, exponent=exponent)
    for first in range(len(sizes) - KEY_EVERY + 1):
        rate = sum(sizes[first : first + KEY_EVERY]) * 8 / 1e6
        slack = 0.25 if first < KEY_EVERY else 0.15  # What a key packet takes shows when the first has come.
        assert (1 - slack) * target_mbits < rate < (1 + slack) * target_mbits, first


def test_without_a_target_nothing_is_pressed() -> None:
    controller = RateController(RateConfig(), FPS)
    controller.add(10**9, PacketKind.DELTA)
    assert controller.pressure == 1.0
    config = OnlineConfig()
    assert pressed(config, 1.0) is config


def test_pressure_has_bounds() -> None:
    for size, expected in ((10**7, MOST), (1, LEAST)):
        controller = RateController(RateConfig(target_mbits=1.0), FPS)
        for _ in range(50):
            controller.add(size, PacketKind.DELTA)
        assert controller.pressure == expected


def test_what_is_pressed() -> None:
    before, after = OnlineConfig(), pressed(OnlineConfig(), 4.0)
    assert after.rounding.rate_weight == 4.0 * before.rounding.rate_weight
    assert after.patching.grad_threshold == 2.0 * before.patching.grad_threshold


@pytest.mark.parametrize("config", [RateConfig(0.0), RateConfig(-1.0), RateConfig(1.0, 0.0)])
def test_targets_that_make_no_sense(config: RateConfig) -> None:
    with pytest.raises(ConfigError, match="both must be positive"):
        RateController(config, FPS)
