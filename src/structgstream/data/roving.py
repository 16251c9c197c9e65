# SPDX-License-Identifier: Apache-2.0
"""Pictures by a camera that was carried through the set, of which frame 0 uses what stands still.

Note [What stands still]
~~~~~~~~~~~~~~~~~~~~~~~~
The roving pictures are of another time: where people are in frame 0, they show what is behind, and people elsewhere.
Many pictures that agree with each other would outvote the still cameras. What moves in frame 0 is known from these: it
differs from the most frequent colour of its pixel over the take. A place in space may be such a thing if all still
cameras that see it have a differing pixel there (a visual hull; Laurentini, PAMI 1994). Pixels of a roving picture
whose ray passes through such a place do not count. Who walks in the roving pictures alone counts in few of them, what
is behind in the others. Who stands at one place throughout the take is not known to move.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.images import opencv, read_picture, reduced_mask, reduced_picture
from structgstream.data.matching import inside, project, rays_of_pixels
from structgstream.data.points import PointsConfig, initial_points
from structgstream.data.prepared import ROVING, PreparedCamera, PreparedCapture
from structgstream.data.source import FrameSource, FrameStream, SourceWrapper, closed, resized_to
from structgstream.data.undistortion import Undistortion
from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame, RovingPicture
from structgstream.geometry import Floats

_log = logging.getLogger(__name__)

INSTANTS = 15  # of the take
MIN_INSTANTS = 3  # below which none is frequent
CHANGED_LEVELS = 12.0  # of 255, in a channel, beyond which two pixels of the reduced pictures differ
REDUCED_SIDE = 160  # pixels, to which the longer side is reduced
REACH_PIXELS = 2  # of the reduced pictures, by which what differs is enlarged
DEPTHS = 96  # places on a ray, evenly in the logarithm of depth: 5 % apart, less than people are thick
FAR_NEARS = 96.0  # near planes to the farthest place on a ray; twice the distance of the farthest camera if larger
MIN_SEEN = 2  # still cameras that see a place
MATCHED_SHARE = 0.02  # matched points of what moves, for each of the hull, below which the hull's are added
NEAR_SHARE = 0.25  # of the near plane of the still cameras: one walks closer to things


@dataclass(frozen=True)
class WithRoving(SourceWrapper):
    """A capture, or a part of it, with the pictures of a roving camera.

    Args:
        whole: the capture over its whole time, with the cameras and pictures of ``source``.
        pictures: as stored, with their cameras; all have one lens.
    """

    whole: FrameSource
    pictures: tuple[tuple[Path, PreparedCamera], ...]
    stored: CameraRig  # the cameras of the capture at the size of their stored pictures

    def resized(self, rig: CameraRig) -> FrameSource:
        """See ``Resizable``."""
        return replace(self, source=resized_to(self.source, rig), whole=resized_to(self.whole, rig))

    def roving(self, frame: MultiViewFrame) -> tuple[RovingPicture, ...]:
        """The pictures for the scene of ``frame``, reduced as the capture's are, and to the size of its largest."""
        name, shown = next(iter(self.rig)), self.pictures[0][1]
        longest = max(side for own in self.rig.cameras.values() for side in (own.width, own.height))
        scale = self.rig[name].width / self.stored[name].width
        scale = min(scale, longest / max(shown.pinhole.width, shown.pinhole.height))
        near, changed = NEAR_SHARE * self.rig[name].near, self._changed(frame)
        undistortion = Undistortion(shown.filmed, shown.pinhole)  # its grids are large: one for all, let go afterwards
        return tuple(
            self._picture(file, replace(own.pinhole.scaled(scale), near=near), undistortion, changed)
            for file, own in self.pictures
        )

    def moving(self, points: Floats, frame: MultiViewFrame) -> NDArray[np.bool_]:
        """Which points ``[P, 3]`` are of what moves in ``frame``."""
        return moving_places(points, self.rig, self._changed(frame))

    def hull(self, frame: MultiViewFrame) -> Floats:
        """Points ``[P, 3]`` on the surface of what may move in ``frame``."""
        return hull_points(self.rig, self._changed(frame))

    def _picture(
        self, file: Path, camera: Camera, undistortion: Undistortion, changed: Mapping[str, NDArray[np.bool_]]
    ) -> RovingPicture:
        picture = read_picture(file)
        filmed = undistortion.filmed.camera
        if picture.shape[1::-1] != (filmed.width, filmed.height):
            raise CaptureError(
                f"The roving picture {file} has {picture.shape[1]}x{picture.shape[0]} pixels, expected {filmed.width}x"
                f"{filmed.height}; prepare the capture again."
            )
        size = camera.width, camera.height
        image = opencv().resize(undistortion(picture), size, interpolation=opencv().INTER_AREA)
        shown = np.ones(image.shape[:2], bool) if undistortion.shown is None else reduced_mask(undistortion.shown, size)
        return RovingPicture(camera, image, shown & ~passes_through(camera, self.rig, changed))

    def _changed(self, frame: MultiViewFrame) -> dict[str, NDArray[np.bool_]]:
        """Where each training camera's picture of ``frame``, reduced, differs from what stands still; empty if the
        capture has fewer than :data:`MIN_INSTANTS` frames."""
        if len(self.whole) < MIN_INSTANTS:
            return {}
        return {
            name: differs(reduced_picture(frame.images[name], REDUCED_SIDE), self._still[name])
            for name in self.rig.training
            if name in frame.images and name in self._still
        }

    @cached_property
    def _still(self) -> dict[str, NDArray[np.uint8]]:
        """What stands still before each camera, reduced."""
        seen: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in self.rig.training}
        count = min(INSTANTS, len(self.whole))
        for index in np.linspace(0, len(self.whole) - 1, count).round().astype(int).tolist():
            with closed(self.whole.frames(index)) as frames:
                shown = next(frames, None)
            images = {} if shown is None else shown.images
            for name in seen.keys() & images.keys():
                seen[name].append(reduced_picture(images[name], REDUCED_SIDE))
        return {name: most_frequent(np.stack(own)) for name, own in seen.items() if own}


def with_roving(source: FrameSource, whole: FrameSource, folder: Path, capture: PreparedCapture) -> FrameSource:
    """``source``, a part of the prepared ``capture`` in ``folder``, with its roving pictures, where it has some."""
    if not capture.roving:
        return source
    pictures = tuple((folder / own.files, own) for own in capture.roving.values())
    if missing := [file for file, _ in pictures if not file.is_file()]:
        raise CaptureError(f"The roving picture {missing[0]} is missing; restore it, or prepare the capture again.")
    stored = source.rig.mapped({name: capture.cameras[name].pinhole for name in source.rig})
    return WithRoving(source, whole, pictures, stored)


def roving_of(source: FrameStream) -> WithRoving | None:
    """The source of roving pictures among the wrappers of ``source``; None without any."""
    inner: Any = source
    while not isinstance(inner, WithRoving | None):
        inner = getattr(inner, "source", None)
    return inner


def frame_points(
    source: FrameStream, frame: MultiViewFrame, *, config: PointsConfig | None = None, seed: int = 0
) -> Floats:
    """Initial points ``[P, 3]`` of a frame; of frame 0 from the roving pictures, too.

    Roving pictures are closer to a still camera than its neighbours are, and have nothing of what moves. So what moves
    has the points of the still cameras alone. Cameras that are far apart hardly match any; then the surface of the hull
    is added, which is too large, and harms where there are matches.
    """
    config, roving = config or PointsConfig(), roving_of(source)
    found = initial_points(frame, source.rig, config=config, seed=seed)
    if roving is None or frame.index > 0:
        return found
    still = initial_points(*joined(source.rig, frame, roving.roving(frame)), config=config, seed=seed)
    moving, hull = found[roving.moving(found, frame)], roving.hull(frame)
    lacking = len(moving) < MATCHED_SHARE * len(hull)
    _log.info("Of what moves %d points were matched; %d of its hull are added", len(moving), lacking * len(hull))
    return np.concatenate([still, moving, hull] if lacking else [still, moving])


def joined(
    rig: CameraRig, frame: MultiViewFrame, pictures: Sequence[RovingPicture]
) -> tuple[MultiViewFrame, CameraRig]:
    """A frame and its rig, with the roving pictures as further cameras."""
    images, masks, cameras = dict(frame.images), dict(frame.masks), dict(rig.cameras)
    for number, own in enumerate(pictures):
        name = f"{ROVING}/{number}"
        images[name], masks[name], cameras[name] = own.image, own.mask, own.camera
    return replace(frame, images=images, masks=masks), CameraRig(cameras, rig.held_out)


def most_frequent(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Of each pixel of ``[T, H, W, 3]`` the one that differs from the fewest others.

    A median fails where people are before a pixel half of the time; they have several colours.
    """
    levels = pictures.astype(np.int16)
    alike = np.stack([(np.abs(levels - own).max(-1) <= CHANGED_LEVELS).sum(0) for own in levels])
    return np.take_along_axis(pictures, alike.argmax(0)[None, ..., None], 0)[0]


def differs(picture: NDArray[np.uint8], still: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where a picture ``[H, W, 3]`` differs from another, but for a change of all pixels; a little enlarged."""
    difference = picture.astype(np.float32) - still
    difference -= np.median(difference, axis=(0, 1))
    changed = (np.abs(difference).max(2) > CHANGED_LEVELS).astype(np.uint8)
    side = 2 * REACH_PIXELS + 1
    return np.asarray(opencv().dilate(changed, np.ones((side, side), np.uint8)), bool)


def passes_through(camera: Camera, rig: CameraRig, changed: Mapping[str, NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Pixels ``[H, W]`` of ``camera`` whose ray passes through a place of Note [What stands still]."""
    small = camera.scaled(min(1.0, REDUCED_SIDE / max(camera.width, camera.height)))
    found = np.zeros((small.height, small.width), bool)
    if changed:
        eye, rays = small.center.numpy(), rays_of_pixels(small) @ small.viewmat[:3, :3].numpy()
        for depth in _depths(eye, small.near, rig, changed):
            found |= moving_places(eye + depth * rays, rig, changed)
    # Its pixels are areas of the picture's.
    whole = opencv().resize(found.astype(np.uint8), (camera.width, camera.height), interpolation=opencv().INTER_NEAREST)
    return np.asarray(whole, bool)


def _depths(eye: Floats, near: float, rig: CameraRig, changed: Mapping[str, NDArray[np.bool_]]) -> Floats:
    """Depths ``[D]`` of the places on a ray from ``eye`` in which what moves is looked for."""
    apart = max(float(np.linalg.norm(rig[name].center.numpy() - eye)) for name in changed)
    return np.geomspace(near, max(FAR_NEARS * near, 2 * apart), DEPTHS)


def hull_points(rig: CameraRig, changed: Mapping[str, NDArray[np.bool_]]) -> Floats:
    """Points ``[P, 3]``: on the ray of each pixel that differs, the nearest place that all still cameras which see it
    take for moving."""
    found = [np.zeros((0, 3))]
    for name, mask in changed.items():
        camera = rig[name].resized(mask.shape[1], mask.shape[0])
        eye, rays = camera.center.numpy(), (rays_of_pixels(camera) @ camera.viewmat[:3, :3].numpy())[mask]
        for depth in _depths(eye, camera.near, rig, changed):
            places = eye + depth * rays
            moving = moving_places(places, rig, changed)
            found.append(places[moving])
            rays = rays[~moving]
    return np.concatenate(found)


def moving_places(points: Floats, rig: CameraRig, changed: Mapping[str, NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Which places ``[..., 3]`` all still cameras that see them take for moving."""
    seen = np.zeros(points.shape[:-1], np.int16)
    moving = np.zeros_like(seen)
    for name, mask in changed.items():
        camera = rig[name].resized(mask.shape[1], mask.shape[0])
        pixels, depths = project(camera, points)
        shown = inside(camera, pixels, depths, near=camera.near)
        column, row = pixels[shown].astype(int).T
        seen += shown
        moving[shown] += mask[row, column]
    return (seen >= MIN_SEEN) & (moving == seen)
