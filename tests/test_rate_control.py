# SPDX-License-Identifier: Apache-2.0
import logging
import random
from collections.abc import Callable

import pytest

from structgstream.codec.packets import PacketKind
from structgstream.errors import ConfigError
from structgstream.rate_control import LEAST, MOST, RateConfig, RateController, with_rate_control
from structgstream.training.online import OnlineConfig

FPS, KEY_EVERY = 30.0, 30


def controller_of(target_mbits: float | None) -> RateController:
    return RateController(RateConfig(target_mbits), FPS, key_interval=KEY_EVERY)


def constant(group: int) -> float:
    return 60e3


def growing(group: int) -> float:
    """As real ones do: with the root of what they have to say."""
    return 14e3 * (KEY_EVERY * group) ** 0.5


def simulated(
    target_mbits: float, *, exponent: float, keys: Callable[[int], float] = constant, frames: int = 240
) -> tuple[list[int], RateController]:
    """Packets of a scene that moves 1.6 times as much from frame 70 on; bytes fall with ``pressure ** -exponent``."""
    controller, noise = controller_of(target_mbits), random.Random(0)
    sizes: list[int] = []
    for index in range(frames):
        key = index % KEY_EVERY == 0
        delta = 14e3 * (1.6 if index > 70 else 1.0) * controller.pressure**-exponent * noise.uniform(0.85, 1.15)
        sizes.append(int((keys(index // KEY_EVERY) if index else 300) if key else delta))
        controller.add(sizes[-1], PacketKind.KEY if key else PacketKind.DELTA)
    return sizes, controller


@pytest.mark.parametrize("keys", [constant, growing])
@pytest.mark.parametrize("exponent", [0.33, 0.6, 1.0])
@pytest.mark.parametrize("target_mbits", [2.4, 3.6, 6.0])
def test_every_window_keeps_to_the_target(target_mbits: float, exponent: float, keys: Callable[[int], float]) -> None:
    sizes, _ = simulated(target_mbits, exponent=exponent, keys=keys)
    windows = [sum(sizes[i : i + KEY_EVERY]) * 8 / 1e6 / target_mbits for i in range(len(sizes) - KEY_EVERY + 1)]
    # What a key packet takes is a guess until the first has come.
    assert 0.8 < min(windows) <= max(windows[:KEY_EVERY]) < 1.25
    later = windows[KEY_EVERY:]
    assert 0.9 < min(later) <= max(later) < 1.08
    assert sum(later) / len(later) == pytest.approx(1.0, abs=0.01)


def test_a_key_packet_is_saved_for_before_it_comes() -> None:
    """With a price that answers at once, the frames before a key packet are as large as those after it."""
    sizes, _ = simulated(6.0, exponent=1.0, keys=growing)
    groups = [sizes[i + 1 : i + KEY_EVERY] for i in range(120, 240, KEY_EVERY)]
    first = sum(sum(group[:10]) for group in groups)
    last = sum(sum(group[-10:]) for group in groups)
    assert last == pytest.approx(first, rel=0.1)


def test_the_pressure_follows_from_the_packets_alone() -> None:
    """What a resumed session does: it tells a new controller of all packets."""
    sizes, controller = simulated(3.6, exponent=0.33, frames=137)
    again = controller_of(3.6)
    for index, size in enumerate(sizes):
        again.add(size, PacketKind.DELTA if index % KEY_EVERY else PacketKind.KEY)
    assert again.pressure == controller.pressure != 1.0


def test_without_a_target_nothing_is_pressed() -> None:
    controller = controller_of(None)
    controller.add(10**9, PacketKind.DELTA)
    assert (controller.pressure, controller.rate_mbits, controller.missed) == (1.0, None, False)
    config = OnlineConfig()
    assert with_rate_control(config, 1.0) is config


def test_pressure_has_bounds_and_changes_step_by_step() -> None:
    for size, expected, step in ((10**7, MOST, 4.0), (1, LEAST, 0.5)):
        controller = controller_of(1.0)
        before = controller.pressure
        controller.add(100, PacketKind.KEY)
        assert controller.pressure == before, "the first packet says nothing"
        for _ in range(28):
            controller.add(size, PacketKind.DELTA)
            assert controller.pressure in (before * step, expected)
            before = controller.pressure
        assert controller.pressure == expected


def test_a_target_that_is_missed_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    controller = controller_of(1.0)
    with caplog.at_level(logging.WARNING):
        for index in range(100):
            controller.add(8000, PacketKind.DELTA if index % KEY_EVERY else PacketKind.KEY)
            assert controller.missed == (index >= KEY_EVERY - 1), "there is a whole window"
    assert controller.rate_mbits == pytest.approx(1.92)
    assert [record.getMessage() for record in caplog.records] == [
        "Frame 29: the last 30 frames take 1.92 Mbit/s, the target is 1; nothing more can be saved: take coarser steps "
        "(online.rounding.quality) or a higher target."
    ]


def test_a_target_that_is_missed_again_is_said_again(caplog: pytest.LogCaptureFixture) -> None:
    controller = controller_of(1.0)
    with caplog.at_level(logging.WARNING):
        for size in (4000, 8000, 2000, 8000):
            for index in range(30):
                controller.add(size, PacketKind.DELTA if index else PacketKind.KEY)
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == ["Frame 34", "Frame 102"]
    assert "more is saved from now on" in caplog.records[1].getMessage()


def test_what_is_pressed() -> None:
    before, after = OnlineConfig(), with_rate_control(OnlineConfig(), 4.0)
    assert after.rounding.rate_weight == 4.0 * before.rounding.rate_weight
    assert after.patching.grad_threshold == 2.0 * before.patching.grad_threshold


@pytest.mark.parametrize("config", [RateConfig(0.0), RateConfig(-1.0), RateConfig(1.0, 0.0)])
def test_targets_that_make_no_sense(config: RateConfig) -> None:
    with pytest.raises(ConfigError, match="both must be positive"):
        RateController(config, FPS, key_interval=KEY_EVERY)


def test_a_window_holds_a_group() -> None:
    with pytest.raises(ConfigError, match=r"over 0.5 s cannot be kept with a key packet every 1 s; make rate.window"):
        RateController(RateConfig(1.0, 0.5), FPS, key_interval=KEY_EVERY)
