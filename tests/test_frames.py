# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame, check_pictures
from tests.support.rigs import arc_rig

RIG = arc_rig()


def test_its_text_tells_shapes_and_not_pixels() -> None:
    images = {name: np.zeros((4, 6, 3), dtype=np.uint8) for name in ("a", "b")}
    assert repr(MultiViewFrame(3, 0.1, images)) == "MultiViewFrame(index=3, pts_seconds=0.1000, 2 x [(4, 6, 3)])"


def frame_of(*blank: str, cameras: int = 5, level: int = 0, noise: int = 3) -> MultiViewFrame:
    """Cameras c0, c1, ... with noise as their pictures; those in ``blank`` show ``level`` and a little noise."""
    generator = np.random.default_rng(0)
    images = {f"c{n}": generator.integers(0, 256, (48, 64, 3), dtype=np.uint8) for n in range(cameras)}
    for name in blank:
        images[name] = (level + generator.integers(0, noise, (48, 64, 3))).astype(np.uint8)
    return MultiViewFrame(0, 0.0, images)


@pytest.mark.parametrize("level", [0, 128, 250])
def test_a_blank_picture_is_there_but_shows_nothing(level: int) -> None:
    frame = frame_of("c1", level=level)
    assert frame.present(["c0", "c1", "c2", "c9"]) == ("c0", "c1", "c2")
    assert frame.showing(frame.images) == ("c0", "c2", "c3", "c4")


def test_pictures_of_a_dark_or_plain_scene_count() -> None:
    assert frame_of("c0", "c1").showing(["c0", "c1", "c2", "c3", "c4"]) == ("c0", "c1", "c2", "c3", "c4")
    later = replace(frame_of("c0", "c1"), index=7)
    assert later.showing(later.images) == ("c2", "c3", "c4"), "what records c0 and c1 has failed"
    dark = replace(frame_of(*later.images), index=7)
    assert dark.showing(dark.images) == ()
    faint = frame_of("c1", noise=12)
    assert faint.showing(faint.images) == tuple(faint.images), "a standard deviation of 3.5 levels is a picture"


def test_what_a_mask_leaves_out_does_not_make_a_picture() -> None:
    frame = frame_of("c1")
    frame.images["c1"][:, :8] = 200
    assert "c1" in frame.showing(frame.images)
    mask = np.ones((48, 64), bool)
    mask[:, :8] = False
    masked = replace(frame, masks={"c1": mask, "c2": np.zeros((48, 64), bool)})
    assert masked.showing(frame.images) == ("c0", "c3", "c4")


def wrong(name: str, image: Any = None, mask: Any = None) -> MultiViewFrame:
    frame = MultiViewFrame(0, 0.0, {name: np.zeros((32, 48, 3), np.uint8) for name in RIG})
    images = {**frame.images, name: frame.images["cam01"] if image is None else image}
    return replace(frame, images=images, masks={} if mask is None else {name: mask})


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (wrong("cam01", np.zeros((32, 48, 3))), r"'cam01' in frame 0 of hall is a ndarray of float64 \[32, 48, 3\]"),
        (wrong("cam01", np.zeros((3, 32, 48), np.uint8)), r"uint8 \[3, 32, 48\]; .* uint8 \[32, 48, 3\], red first"),
        (wrong("cam01", np.zeros((16, 24, 3), np.uint8)), r"uint8 \[16, 24, 3\]"),
        (wrong("cam01", torch.zeros(32, 48, 3, dtype=torch.uint8)), r"a Tensor of uint8"),
        (wrong("cam01", mask=np.full((32, 48), 255, np.uint8)), r"mask of camera 'cam01' .* uint8 .* bool \[32, 48\]"),
        (wrong("cam1"), r"a picture of camera 'cam1', which the rig does not have; its cameras are cam00, cam01"),
    ],
)
def test_pictures_of_another_type_or_size_are_refused(frame: MultiViewFrame, words: str) -> None:
    check_pictures(wrong("cam01", mask=np.ones((32, 48), bool)), RIG, capture="hall")
    with pytest.raises(CaptureError, match=words):
        check_pictures(frame, RIG, capture="hall")


def test_pictures_of_held_out_cameras_are_not_looked_at() -> None:
    check_pictures(wrong("cam00", np.zeros(3)), RIG, capture="hall")
