# SPDX-License-Identifier: Apache-2.0
"""Where flow leads, and where it can be believed."""

import numpy as np
import pytest

from structgstream.flow import consistency_mask, inside, picture_shift, same_color, sampled


def constant(dx: float, dy: float, height: int = 6, width: int = 8) -> np.ndarray:
    return np.broadcast_to(np.array([dx, dy], np.float32), (height, width, 2)).copy()


def test_the_rule_of_occlusion_at_its_threshold() -> None:
    def holds(rest: float, length: float) -> bool:
        backward, forward = constant(-length, 0, width=40), constant(length + rest, 0, width=40)
        return bool(consistency_mask(backward, forward)[3, 20])

    # At rest r and lengths a, a + r: r^2 <= 0.01 (a^2 + (a + r)^2) + 0.5.
    assert holds(0.70, 0.0)
    assert not holds(0.72, 0.0)
    assert holds(1.65, 10.0)  # 2.72 against 2.86
    assert not holds(1.75, 10.0)  # 3.06 against 2.88


def test_pixels_from_beyond_the_border_are_outside() -> None:
    mask = inside(constant(-2.5, 1.0))
    assert mask[:5, 3:].all()
    assert not mask[:, :3].any()
    assert not mask[5].any()


def test_sampling_is_bilinear() -> None:
    height, width = 6, 8
    y, x = np.mgrid[:height, :width].astype(np.float32)
    values = np.stack([x, y, 2 * x - y], 2)
    taken = sampled(values, constant(-0.25, 0.5))
    expected = np.stack([x - 0.25, y + 0.5, 2 * (x - 0.25) - (y + 0.5)], 2)
    np.testing.assert_allclose(taken[:5, 1:], expected[:5, 1:], atol=1e-4)
    assert taken[0, 0, 0] == pytest.approx(0.0, abs=1e-5)  # the border's value beyond it


@pytest.mark.parametrize("shift", [(0, 0), (7, -4), (-2, 3)])
def test_the_shift_of_a_whole_picture(shift: tuple[int, int]) -> None:
    """Also where a part of it moves otherwise, and where light has changed."""
    rough = np.random.default_rng(3).random((90, 120, 1)).astype(np.float32)
    scene = np.repeat(sampled(rough, np.zeros((90, 120, 2), np.float32)), 3, axis=2) * 200
    first = scene.astype(np.uint8)
    second = np.roll(first, (shift[1], shift[0]), axis=(0, 1))
    second[20:50, 30:60] = first[22:52, 41:71]
    second = (second * 0.8 + 20).astype(np.uint8)
    found, clarity = picture_shift(first, second)
    assert found == pytest.approx(np.hypot(*shift), abs=0.5)
    assert clarity > 0.3


def test_pictures_of_different_things_have_no_clear_shift() -> None:
    first, second = np.random.default_rng(4).integers(0, 255, (2, 90, 120, 3), dtype=np.uint8)
    assert picture_shift(first, second)[1] < 0.3
    assert picture_shift(first[:1], second[:1]) == (0.0, 0.0)


def thrown(light: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A plain square that moves by 12 pixels in front of a still ground, in light that changes, and its pixels."""
    ground = np.kron(np.random.default_rng(0).integers(40, 120, (20, 30, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    first, second = ground.copy(), ground + np.uint8(light)
    square = np.zeros(first.shape[:2], bool)
    square[30:50, 30:50] = True
    first[square], second[np.roll(square, 12, 1)] = (220, 120, 30), (220 + light, 120 + light, 30 + light)
    return first, second, square


@pytest.mark.parametrize("light", [0, 35])
def test_consistent_flow_that_leads_to_another_color_is_wrong(light: int) -> None:
    first, second, square = thrown(light)
    flow = constant(0, 0, *square.shape)
    assert consistency_mask(flow, flow).all()
    still = same_color(first, second, flow, radius=1)
    assert not still[32:48, 32:40].any(), "the ground is there now"
    assert still[~(square | np.roll(square, 12, 1))].mean() > 0.95
    flow[square] = 12, 0
    assert same_color(first, second, flow, radius=1)[32:48, 32:48].all()
