# SPDX-License-Identifier: Apache-2.0
"""Two captures have one fingerprint when they give the same pictures of the same cameras, and not otherwise."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.errors import CaptureError, ConfigError
from structgstream.frames import MultiViewFrame
from structgstream_studies.experiments.captures import CapturePart, capture_facts, fingerprint
from tests.support.rigs import arc_rig

CLIP = CapturePart(bundled_clip_path(), scale=0.25, frames=4)


@dataclass(frozen=True)
class Pictures:
    """A capture of given pictures, a row of them for each frame."""

    rig: CameraRig
    rows: tuple[Mapping[str, NDArray[np.uint8]], ...]
    fps: float = 30.0
    name: str = "given"
    points: None = None

    def __len__(self) -> int:
        return len(self.rows)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for index in range(start, len(self)):
            yield MultiViewFrame(index, index / self.fps, self.rows[index])


def pictures() -> Pictures:
    rig = arc_rig(4, width=8, height=6).with_held_out(frozenset({"cam00"}))
    rng = np.random.default_rng(5)
    rows = tuple({name: rng.integers(0, 255, (6, 8, 3), dtype=np.uint8) for name in rig} for _ in range(3))
    return Pictures(rig, rows)


def with_pixel(source: Pictures, *, frame: int) -> Pictures:
    rows = [{name: image.copy() for name, image in row.items()} for row in source.rows]
    rows[frame]["cam02"][3, 4, 1] ^= 1
    return replace(source, rows=tuple(rows))


def with_camera(source: Pictures, edit: Callable[[Any], Any]) -> Pictures:
    cameras = dict(source.rig.cameras)
    return replace(source, rig=source.rig.mapped(cameras | {"cam01": edit(cameras["cam01"])}))


def moved(camera: Any) -> Any:
    viewmat = camera.viewmat.clone()
    viewmat[0, 3] += 1e-9
    return replace(camera, viewmat=viewmat)


def zoomed(camera: Any) -> Any:
    K = camera.K.clone()
    K[0, 0] += 1e-6
    return replace(camera, K=K)


CHANGES: dict[str, Callable[[Pictures], Pictures]] = {
    "a level of the first picture": lambda source: with_pixel(source, frame=0),
    "a level of the last picture": lambda source: with_pixel(source, frame=2),
    "a pose": lambda source: with_camera(source, moved),
    "a focal length": lambda source: with_camera(source, zoomed),
    "a near plane": lambda source: with_camera(source, lambda camera: replace(camera, near=camera.near * 1.01)),
    "the split": lambda source: replace(source, rig=source.rig.with_held_out(frozenset({"cam01"}))),
    "the last frame": lambda source: replace(source, rows=source.rows[:2]),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_the_fingerprint_changes_with(change: Callable[[Pictures], Pictures]) -> None:
    assert fingerprint(change(pictures())) != fingerprint(pictures())


def test_the_fingerprint_is_of_what_is_seen_and_not_of_the_name() -> None:
    assert fingerprint(replace(pictures(), name="another")) == fingerprint(pictures())
    assert len(fingerprint(pictures())) == 64


def test_facts_of_a_part() -> None:
    source = CLIP.open()
    facts = capture_facts(CLIP, source)
    assert facts == {
        "name": "clip",
        "fingerprint": fingerprint(source),
        "frames": 4,
        "start": 0,
        "every": 1,
        "scale": 0.25,
        "near": None,
        "fps": 30.0,
        "sizes": [[80, 60]],
        "training_cameras": 9,
        "held_out": ["cam00"],
        "scored": ["cam00"],
    }


def test_facts_of_another_split() -> None:
    part = replace(CLIP, held_out=("cam01", "cam05"), scored=("cam05",))
    facts = capture_facts(part, part.open())
    assert (facts["training_cameras"], facts["held_out"], facts["scored"]) == (8, ["cam01", "cam05"], ["cam05"])


def test_a_part_gives_the_frames_it_names() -> None:
    whole = [*replace(CLIP, frames=None).open().frames()]
    part = replace(CLIP, start=1, frames=7, every=3).open()
    assert len(part) == 3
    for frame, expected in zip(part.frames(), (whole[1], whole[4], whole[7]), strict=True):
        np.testing.assert_array_equal(frame.images["cam03"], expected.images["cam03"])
    assert [frame.index for frame in part.frames()] == [0, 1, 2]


@pytest.mark.parametrize(
    ("part", "error"),
    [
        (replace(CLIP, frames=13), CaptureError),
        (replace(CLIP, held_out=("nobody",)), CaptureError),
        (replace(CLIP, folder=Path("nowhere")), CaptureError),
        (replace(CLIP, every=0), ConfigError),
    ],
)
def test_a_part_that_is_not_there(part: CapturePart, error: type[Exception]) -> None:
    with pytest.raises(error):
        part.open()
