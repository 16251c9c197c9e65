# SPDX-License-Identifier: Apache-2.0
"""Pictures of a roving camera: which pixels stand still, and how a prepared capture has them."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data import roving as roving_module
from structgstream.data.lenses import LensCamera, Pinhole, RadialTangential
from structgstream.data.open import open_capture
from structgstream.data.prepared import PreparedCamera, PreparedCapture, prepared_entries, read_prepared, write_prepared
from structgstream.data.roving import (
    WithRoving,
    differs,
    frame_points,
    hull_points,
    joined,
    most_frequent,
    passes_through,
    roving_of,
)
from structgstream.data.source import FrameStream, Prefetch, resized
from structgstream.data.undistortion import Undistortion, rectilinear
from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame, RovingPicture
from tests.support.captures import HEIGHT, WIDTH, small_rig, write_picture
from tests.support.rigs import arc_rig, look_at

FRAMES = 5


def ball(camera: Camera, *, radius: float, factor: float = 1.0) -> NDArray[np.bool_]:
    """Pixels ``[H, W]`` whose ray passes the origin within ``factor`` radii."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(camera.K.numpy()).T
    rays = rays @ camera.viewmat[:3, :3].numpy()
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return np.asarray(np.linalg.norm(np.cross(rays, camera.center.numpy()), axis=-1) < factor * radius)


def ball_rig(*, radius: float) -> tuple[CameraRig, dict[str, NDArray[np.bool_]]]:
    """Six cameras that look at a ball in the origin, and the pixels of each that it covers."""
    rig = arc_rig(6, width=160, height=120)
    larger = torch.tensor([[3.3], [3.3], [1.0]])
    to_middle = torch.tensor([[0, 0, 80], [0, 0, 60], [0, 0, 0]])
    rig = rig.mapped({name: replace(rig[name], K=rig[name].K.tril() * larger + to_middle) for name in rig})
    return rig, {name: ball(rig[name], radius=radius) for name in rig.training}


@pytest.mark.parametrize("near", [0.5, 0.04, 0.001])
def test_rays_through_what_moves_before_the_still_cameras_do_not_count(near: float) -> None:
    rig, changed = ball_rig(radius=0.3)
    eye = torch.tensor([0.6, -1.4, -2.2], dtype=torch.float64)
    camera = replace(rig["cam00"], viewmat=look_at(eye, torch.zeros(3, dtype=torch.float64)), near=near)
    moving = passes_through(camera, rig, changed)
    assert moving[ball(camera, radius=0.3, factor=0.9)].all()
    assert not moving[~ball(camera, radius=0.3, factor=2.0)].any()
    assert not passes_through(camera, rig, {}).any()
    one = {name: mask if name == rig.training[0] else np.zeros_like(mask) for name, mask in changed.items()}
    assert not passes_through(camera, rig, one).any()  # the others see that nothing moves there


def test_each_pixel_of_what_moves_has_a_point_on_the_side_that_its_camera_sees() -> None:
    rig, changed = ball_rig(radius=0.3)
    points = hull_points(rig, changed)
    pixels = sum(int(mask.sum()) for mask in changed.values())
    assert 1000 < 0.98 * pixels <= len(points) <= pixels  # rays at the rim may pass all other cameras' pixels
    away = np.linalg.norm(points, axis=1)
    assert (away > 0.2).all()
    assert (away < 0.7).all()  # cameras on one side alone: the hull is longer than the ball
    assert np.median(away) < 0.4
    cameras = np.mean([rig[name].center.numpy() for name in changed], axis=0)
    assert (points @ cameras > -0.05 * np.linalg.norm(cameras)).mean() > 0.95
    assert not len(hull_points(rig, {}))


def test_what_stands_still_is_found_behind_people_who_are_there_most_of_the_time() -> None:
    pictures = np.full((7, 4, 6, 3), 90, np.uint8)
    for instant, level in enumerate((130, 170, 200, 230)):  # four of seven instants, never the same
        pictures[instant, 1:3, 2:4] = level
    still = most_frequent(pictures)
    assert (still == 90).all()
    assert (np.median(pictures, axis=0)[1, 2] != 90).all()
    assert differs(pictures[0], still)[1:3, 2:4].all()


def test_a_change_of_light_is_no_motion() -> None:
    still = np.random.default_rng(0).integers(40, 200, (90, 120, 3)).astype(np.uint8)
    assert not differs(still + np.uint8(30), still).any()
    moved = still.copy()
    moved[40:50, 60:70] = 255 - moved[40:50, 60:70]
    found = differs(moved + np.uint8(0), still)
    assert found[40:50, 60:70].all()
    assert not found[:30].any()


def write_capture(folder: Path) -> PreparedCapture:
    """Four cameras of which nothing moves but a square, and two roving pictures."""
    cameras = {}
    rng = np.random.default_rng(1)
    for name, camera in small_rig().cameras.items():
        picture = rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        for frame in range(FRAMES):
            shown = picture.copy()
            shown[20:28, 6 + 10 * frame : 14 + 10 * frame] = (255, 0, 255)
            write_picture(folder / "pictures" / name / f"{frame:04d}.png", shown)
        cameras[name] = PreparedCamera(f"pictures/{name}", LensCamera(camera, Pinhole()), camera)
    roving = {}
    for number in range(2):
        name = f"roving/{number:06d}"
        filmed = LensCamera(small_rig()["cam02"], RadialTangential(k1=-0.05))
        roving[name] = PreparedCamera(f"{name}.png", filmed, rectilinear(filmed))
        write_picture(folder / f"{name}.png", np.full((HEIGHT, WIDTH, 3), 100 + number, np.uint8))
    content = PreparedCapture(cameras, 30.0, 0.25, held_out=frozenset({"cam01"}), roving=roving)
    write_prepared(folder, content)
    return content


def roving_pictures(source: FrameStream) -> tuple[RovingPicture, ...]:
    """Those for the first frame."""
    roving = roving_of(source)
    assert roving is not None
    return roving.roving(next(source.frames()))


def test_a_capture_has_its_roving_pictures(tmp_path: Path) -> None:
    content = write_capture(tmp_path)
    found = read_prepared(tmp_path)
    assert prepared_entries(found) == prepared_entries(content)
    source = open_capture(tmp_path, start=1, frames=2)
    assert [*source.rig] == [*small_rig()]
    frame = next(source.frames())
    pictures = roving_pictures(Prefetch(source))
    assert [int(np.median(own.image)) for own in pictures] == [100, 101]
    assert [own.camera.width for own in pictures] == [WIDTH, WIDTH]
    assert pictures[0].camera.near == pytest.approx(0.25 * 0.25)
    assert 0 < pictures[0].mask.mean() < 1  # what moves in the frame is left out
    more, rig = joined(source.rig, frame, pictures)
    assert [*rig][-2:] == ["roving/0", "roving/1"]
    assert rig.testing == ("cam01",)
    assert more.masks["roving/0"] is pictures[0].mask or (more.masks["roving/0"] == pictures[0].mask).all()


@pytest.mark.parametrize(("count", "added"), [(100, 100), (10, 0)])
def test_what_moves_has_the_points_of_the_still_cameras_and_of_its_hull_if_these_are_few(
    count: int, added: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write_capture(tmp_path)
    source = open_capture(tmp_path)
    moving, still, behind = np.array([[0.0, 0.0, 0.0]]), np.array([[0.5, 0.5, 0.5]]), np.array([[0.1, 0.2, 3.0]])

    def found(frame: MultiViewFrame, rig: CameraRig, **options: Any) -> Any:
        return behind if "roving/0" in rig.cameras else np.concatenate([moving, still])

    monkeypatch.setattr(roving_module, "initial_points", found)
    monkeypatch.setattr(WithRoving, "moving", lambda self, points, frame: (points == 0).all(1))
    hull = np.tile([0.1, 0.0, 0.0], (count, 1))
    monkeypatch.setattr(WithRoving, "hull", lambda self, frame: hull)
    frame = next(source.frames())
    with caplog.at_level("INFO"):
        np.testing.assert_array_equal(frame_points(source, frame), np.concatenate([behind, moving, hull[:added]]))
    assert f"Of what moves 1 points were matched; {added} of its hull are added" in caplog.text
    np.testing.assert_array_equal(frame_points(source, replace(frame, index=1)), np.concatenate([moving, still]))
    alone = open_capture(tmp_path, roving=False)
    np.testing.assert_array_equal(frame_points(alone, frame), np.concatenate([moving, still]))


def test_roving_pictures_are_reduced_as_the_capture_is(tmp_path: Path) -> None:
    write_capture(tmp_path)
    for source in (open_capture(tmp_path, scale=0.5), resized(open_capture(tmp_path), 0.5)):
        one, _ = roving_pictures(source)
        assert one.image.shape == (HEIGHT // 2, WIDTH // 2, 3)
        assert (one.camera.height, one.camera.width) == one.mask.shape


def test_roving_pictures_are_no_larger_than_those_of_the_cameras(tmp_path: Path) -> None:
    content = write_capture(tmp_path)
    larger = {}
    for name, own in content.roving.items():
        filmed = replace(own.filmed, camera=own.filmed.camera.scaled(3.0))
        larger[name] = PreparedCamera(own.files, filmed, rectilinear(filmed))
        write_picture(tmp_path / own.files, np.full((3 * HEIGHT, 3 * WIDTH, 3), 100, np.uint8))
    write_prepared(tmp_path, replace(content, roving=larger))
    for scale in (1.0, 0.5):
        source = open_capture(tmp_path, scale=scale)
        for own in roving_pictures(source):
            assert own.image.shape == (HEIGHT * scale, WIDTH * scale, 3)
            assert (own.camera.width, own.camera.height) == (WIDTH * scale, HEIGHT * scale)


def test_the_lens_of_all_roving_pictures_is_computed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_capture(tmp_path)
    counted = Mock(wraps=Undistortion)
    monkeypatch.setattr(roving_module, "Undistortion", counted)
    first, second = roving_pictures(open_capture(tmp_path))
    assert counted.call_count == 1
    assert first.image.shape == second.image.shape


def test_roving_pictures_can_be_left_out(tmp_path: Path) -> None:
    content = write_capture(tmp_path)
    np.save(tmp_path / "points.npy", np.zeros((3, 3)))
    write_prepared(tmp_path, replace(content, points="points.npy"))
    assert open_capture(tmp_path).points is not None
    source = open_capture(tmp_path, roving=False)
    assert roving_of(source) is None
    assert source.points is None  # roving pictures helped to find them


def test_pictures_of_a_scale_are_the_same_without_roving_pictures(tmp_path: Path) -> None:
    """A stream of ``--roving none --scale 0.5`` is evaluated on the pictures that it was trained on."""
    content = write_capture(tmp_path)
    cameras = {}
    for name, own in content.cameras.items():
        filmed = replace(own.filmed, lens=RadialTangential(k1=-0.05))
        cameras[name] = replace(own, filmed=filmed, pinhole=rectilinear(filmed))
    write_prepared(tmp_path, replace(content, cameras=cameras))
    sources = [
        open_capture(tmp_path, scale=0.5),
        open_capture(tmp_path, scale=0.5, roving=False),
        resized(open_capture(tmp_path), 0.5),
        resized(open_capture(tmp_path, roving=False), 0.5),
    ]
    first, *others = [next(source.frames()).images["cam00"] for source in sources]
    for other in others:
        np.testing.assert_array_equal(first, other)


def test_a_roving_picture_that_lacks_is_named(tmp_path: Path) -> None:
    write_capture(tmp_path)
    (tmp_path / "roving/000001.png").unlink()
    with pytest.raises(CaptureError, match="The roving picture .*000001.png is missing"):
        open_capture(tmp_path)


def test_a_roving_picture_of_another_size_is_named(tmp_path: Path) -> None:
    write_capture(tmp_path)
    write_picture(tmp_path / "roving/000001.png", np.zeros((HEIGHT // 2, WIDTH, 3), np.uint8))
    with pytest.raises(CaptureError, match=r"000001.png has 64x24 pixels, expected 64x48"):
        roving_pictures(open_capture(tmp_path))
