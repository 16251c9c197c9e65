# SPDX-License-Identifier: Apache-2.0
"""Anchors show as a mixture where a picture is as in neither of two frames."""

from dataclasses import replace

import pytest
from torch import Tensor

from structgstream import cameras
from structgstream.cameras import CameraRig
from structgstream.groups.base import GroupBase
from structgstream.groups.seam_blend import draw_border, visible_mixtures
from structgstream.scene.scene import Scene
from tests.support.backends import quickest_backend
from tests.support.clip_groups import made


@pytest.fixture(scope="module")
def base() -> tuple[Scene, CameraRig]:
    found = GroupBase.read(made().header)
    return found.scene(), found.header.similarity.rig(found.header.rig)


def middle(scene: Scene) -> Tensor:
    """The tenth of the anchors that is nearest to their centre."""
    apart = (scene.anchors.positions - scene.anchors.positions.median(0).values).norm(dim=1)
    return apart < apart.quantile(0.1)


def displaced(scene: Scene, rows: Tensor, by: float = 0.3) -> Scene:
    positions = scene.anchors.positions + by * rows[:, None]
    return replace(scene, anchors=replace(scene.anchors, positions=positions))


def test_what_either_frame_shows_is_no_mixture(base: tuple[Scene, CameraRig]) -> None:
    scene, rig = base
    backend = quickest_backend()
    assert not visible_mixtures(scene, draw_border(scene, scene, rig, backend), rig, backend).any()
    other = displaced(scene, middle(scene))
    assert not visible_mixtures(scene, draw_border(other, scene, rig, backend), rig, backend).any()


def test_what_neither_frame_shows_is_found_where_it_is(base: tuple[Scene, CameraRig]) -> None:
    scene, rig = base
    there = middle(scene)
    backend = quickest_backend()
    found = visible_mixtures(displaced(scene, there), draw_border(scene, scene, rig, backend), rig, backend)
    assert found[there].float().mean() > 2.0 * found[~there].float().mean() > 0.0


def test_what_shows_is_the_same_in_larger_pictures(
    base: tuple[Scene, CameraRig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Coverage is measured at one size, so that specks count in large pictures as they do in small ones."""
    scene, rig = base
    there, backend = middle(scene), quickest_backend()
    sides = max(max(rig[name].width, rig[name].height) for name in rig)
    large = replace(rig, cameras={name: rig[name].resized(2 * rig[name].width, 2 * rig[name].height) for name in rig})
    monkeypatch.setattr(cameras, "REFERENCE_PIXELS", sides)
    found = [
        visible_mixtures(displaced(scene, there), draw_border(scene, scene, of, backend), of, backend)
        for of in (rig, large)
    ]
    other = (found[0] != found[1]).float().mean() / found[0].float().mean()
    assert float(other) < 0.3  # 0.62 if coverage is in pixels of each size.
