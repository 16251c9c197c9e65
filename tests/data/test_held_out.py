# SPDX-License-Identifier: Apache-2.0
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.cameras import Camera, CameraRig
from structgstream.data.camera_spacing import best_surrounded
from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.open import open_capture
from structgstream.errors import ConfigError
from tests.support.captures import small_rig, write_clip
from tests.support.properties import examples
from tests.support.rigs import look_at

K = torch.tensor([[40.0, 0, 24], [0, 40.0, 16], [0, 0, 1]], dtype=torch.float64)


def rig_of(eyes: Mapping[str, Iterable[float]], *, target: Iterable[float] = (0.0, 0.0, 0.0)) -> CameraRig:
    """Cameras at these places that look at ``target``."""
    at = torch.tensor(list(target), dtype=torch.float64)
    return CameraRig(
        {
            name: Camera(look_at(torch.tensor(list(eye), dtype=torch.float64), at), K, 48, 32)
            for name, eye in eyes.items()
        }
    )


def on_sphere(azimuth: float, elevation: float, *, radius: float = 3.0) -> tuple[float, float, float]:
    """A place seen from the origin; degrees, world y points down."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return radius * math.cos(e) * math.sin(a), -radius * math.sin(e), -radius * math.cos(e) * math.cos(a)


def test_in_a_grid_it_is_the_one_in_the_middle() -> None:
    grid = {f"{row}{column}": on_sphere(10 * column - 20, 10 * row) for row in range(3) for column in range(5)}
    assert best_surrounded(rig_of(grid)) == "12"


def test_a_flat_array_of_parallel_cameras_is_judged_by_position() -> None:
    eyes = {f"{row}{column}": (0.2 * column, 0.2 * row, 0.0) for row in range(5) for column in range(5)}
    viewmats = {name: torch.eye(4, dtype=torch.float64) for name in eyes}
    for name, eye in eyes.items():
        viewmats[name][:3, 3] = -torch.tensor(eye, dtype=torch.float64)
    assert best_surrounded(CameraRig({name: Camera(viewmats[name], K, 48, 32) for name in eyes})) == "22"


def test_in_a_ring_it_is_where_the_cameras_stand_densely() -> None:
    azimuths = {"a": 0, "b": 60, "c": 120, "d": 180, "e": 200, "f": 220, "g": 280}
    assert best_surrounded(rig_of({name: on_sphere(azimuth, 15) for name, azimuth in azimuths.items()})) == "e"


def dome(rings: Mapping[float, int]) -> dict[str, tuple[float, float, float]]:
    return {
        f"{elevation:g}-{i}": on_sphere(360 / count * i, elevation)
        for elevation, count in rings.items()
        for i in range(count)
    }


def test_in_a_dome_it_is_not_in_the_lowest_ring() -> None:
    assert not best_surrounded(rig_of(dome({0: 10, 25: 10, 50: 8, 75: 4}))).startswith("0-")


def test_a_pair_that_stands_close_at_the_rim_is_not_taken() -> None:
    grid = {f"{row}{column}": on_sphere(15 * column - 30, 15 * row) for row in range(3) for column in range(5)}
    close = {"near": on_sphere(-31, 15), "nearer": on_sphere(-31, 16)}
    assert best_surrounded(rig_of(grid | close)) == "12"


def test_a_camera_that_looks_elsewhere_is_neither_taken_nor_surrounds() -> None:
    arc = {f"c{i}": on_sphere(12 * i - 24, 10) for i in range(5)}
    rig = rig_of(arc)
    away = rig_of({"a": on_sphere(0, 10), "b": on_sphere(1, 10)}, target=on_sphere(0, 10, radius=9.0)).cameras
    assert best_surrounded(CameraRig({"away": away["a"], **rig.cameras})) == "c2"
    assert best_surrounded(CameraRig({"away": away["a"], "too": away["b"], **rig.cameras})) == "c2"


@examples(100)
@given(
    seed=st.integers(0, 2**20),
    scale=st.floats(1e-3, 1e3),
    places=st.lists(st.tuples(st.floats(-60, 60), st.floats(-30, 40)), min_size=3, max_size=12, unique=True),
)
def test_neither_unit_nor_world_nor_order_matters(seed: int, scale: float, places: list[tuple[float, float]]) -> None:
    g = np.random.default_rng(seed)
    # A grain apart, so that the choice is not a tie that the order decides.
    eyes = {f"c{i}": on_sphere(*(np.round(place, 2) + g.uniform(-0.4, 0.4, 2))) for i, place in enumerate(places)}
    rig = rig_of(eyes)
    turn = np.linalg.qr(g.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    moved = {}
    for name in g.permutation(list(rig)):
        viewmat = rig[name].viewmat.clone()
        viewmat[:3, :3] = viewmat[:3, :3] @ torch.from_numpy(turn.T)
        viewmat[:3, 3] = scale * viewmat[:3, 3]
        moved[name] = Camera(viewmat, K, 48, 32)
    assert best_surrounded(CameraRig(moved)) == best_surrounded(rig)


def test_two_cameras_can_spare_none() -> None:
    with pytest.raises(ConfigError, match=r"rig has 2 \(a, b\)"):
        best_surrounded(rig_of({"a": (0, 0, -2), "b": (1, 0, -2)}))


def test_the_bundled_clip_holds_out_the_camera_that_it_would_choose() -> None:
    rig = bundled_clip().rig
    assert {best_surrounded(rig)} == rig.held_out


def test_a_capture_opens_with_the_camera_best_surrounded(tmp_path: Path) -> None:
    write_clip(tmp_path)
    chosen = best_surrounded(small_rig())
    for held_out in ("auto", ("auto",)):
        assert open_capture(tmp_path, held_out=held_out).rig.testing == (chosen,)  # pyright: ignore[reportArgumentType]


def test_a_name_that_is_no_tuple_is_refused(tmp_path: Path) -> None:
    write_clip(tmp_path)
    with pytest.raises(ConfigError, match=r"\('cam00',\), or 'auto'"):
        open_capture(tmp_path, held_out="cam00")  # pyright: ignore[reportArgumentType]
