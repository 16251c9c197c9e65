# SPDX-License-Identifier: Apache-2.0
"""Changes of pictures."""

import numpy as np

from structgstream.preparation.synchronization.motion_signals import picture_changes

STAMPS = np.array([0.0, 0.1, 0.25, 0.3])


def pictures(*, square: bool = True, noise: float = 2.0) -> list[np.ndarray]:
    """Grey with noise, and a bright square that jumps to the right at the third picture."""
    generator = np.random.default_rng(0)
    made = []
    for index in range(4):
        picture = generator.normal(100, noise, (120, 200, 3))
        if square:
            left = 40 if index < 2 else 120
            picture[50:80, left : left + 30] += 80
        made.append(np.clip(picture, 0, 255).astype(np.uint8))
    return made


def test_changes_are_where_and_when_something_moves() -> None:
    changes = picture_changes(pictures(), STAMPS)
    assert changes.amounts.shape == (3, 96, 160)
    assert np.allclose(changes.times, [0.05, 0.175, 0.275])
    assert changes.activity.argmax() == 1
    assert changes.moving
    jump = changes.amounts[1]
    assert jump[52, 44] > 40  # the middle of where it was, in reduced pixels
    assert jump[52, 108] > 40
    assert jump[:30].max() < 10


def test_noise_is_no_motion() -> None:
    for noise in (0.0, 2.0, 8.0):
        assert not picture_changes(pictures(square=False, noise=noise), STAMPS).moving


def test_one_picture_has_no_changes() -> None:
    changes = picture_changes(pictures()[:1], STAMPS)
    assert len(changes.times) == 0
    assert not changes.moving
