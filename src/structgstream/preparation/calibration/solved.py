# SPDX-License-Identifier: Apache-2.0
"""What a calibration gives: cameras, points, and what was observed of them; its unit and axes."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from structgstream.data.calibration import Alignment, alignment
from structgstream.data.lenses import LensCamera
from structgstream.errors import CalibrationError
from structgstream.geometry import Floats, Indices


@dataclass(frozen=True)
class Observations:
    """Where points were seen, an entry for each observation."""

    point: Indices  # ``[M]``, index of the point
    camera: Indices  # ``[M]``, index of the camera, in the order of the solved cameras
    pixels: Floats  # ``[M, 2]``, as filmed, so with the lens' distortion
    instant: Indices  # ``[M]``, index of the first instant at which it was seen there

    def __len__(self) -> int:
        return len(self.point)


@dataclass(frozen=True)
class RovingFrames:
    """Frames of a camera that was walked through the set, registered with the still cameras."""

    cameras: Mapping[str, LensCamera]  # by frame; all have one lens
    looked_at: int  # number of frames that were tried
    median_pixels: float  # of their reprojection errors
    bridged: tuple[str, ...] = ()  # still cameras that could not be placed without them

    @property
    def summary(self) -> str:
        """For users."""
        placed = f"{len(self.cameras)} of {self.looked_at} roving frames"
        text = f"{placed}, median reprojection error {self.median_pixels:.2f} px"
        return f"{text}, which connect {', '.join(self.bridged)}" if self.bridged else text


@dataclass(frozen=True)
class SolvedCalibration:
    """Cameras with lenses, estimated from their pictures."""

    cameras: Mapping[str, LensCamera]  # those that could be placed, in the order of the pictures
    points: Floats  # ``[P, 3]``
    observations: Observations  # where the points were seen
    missing: tuple[str, ...] = ()  # names of the cameras that could not be placed
    metres: bool = False  # whether the unit is a metre; otherwise it is arbitrary
    roving: RovingFrames | None = None  # None without a roving camera

    def errors(self) -> Floats:
        """Reprojection error ``[M]`` of each observation, pixels; NaN where a point is out of a lens' reach."""
        seen = self.observations
        found = np.full((len(seen), 2), np.nan)
        for index, filmed in enumerate(self.cameras.values()):
            own = seen.camera == index
            found[own] = filmed.pixels(self.points[seen.point[own]]) - seen.pixels[own]
        return np.linalg.norm(found, axis=1)

    def track_lengths(self) -> Indices:
        """Number of observations ``[P]`` of each point."""
        return np.bincount(self.observations.point, minlength=len(self.points))

    def aligned(self, alignment: Alignment, *, metres: bool | None = None) -> "SolvedCalibration":
        """The same calibration in other coordinates; pictures and errors stay what they are."""

        def moved(cameras: Mapping[str, LensCamera]) -> dict[str, LensCamera]:
            return {name: alignment.filmed(filmed) for name, filmed in cameras.items()}

        return replace(
            self,
            cameras=moved(self.cameras),
            points=alignment.points(self.points),
            metres=self.metres if metres is None else metres,
            roving=None if self.roving is None else replace(self.roving, cameras=moved(self.roving.cameras)),
        )


def normalized(solved: SolvedCalibration) -> SolvedCalibration:
    """With the axes of the first camera, the mean camera at the origin and the farthest one unit away from it."""
    rotation = next(iter(solved.cameras.values())).camera.viewmat[:3, :3].numpy()
    centers = np.stack([filmed.camera.center.numpy() for filmed in solved.cameras.values()])
    scale = 1 / max(float(np.linalg.norm(centers - centers.mean(0), axis=1).max()), 1e-300)
    return solved.aligned(Alignment(scale, rotation, -scale * rotation @ centers.mean(0)))


def rig_alignment(estimated: Mapping[str, LensCamera], reference: Mapping[str, LensCamera]) -> Alignment:
    """The similarity from ``estimated`` to ``reference``, by the cameras that both have.

    Raises:
        CalibrationError: fewer than two cameras in common.
    """
    common = [name for name in estimated if name in reference]
    if len(common) < 2:
        raise CalibrationError(
            f"Two calibrations need two cameras in common to be compared; they have {', '.join(common) or 'none'}."
        )
    return alignment(
        {name: estimated[name].camera.viewmat.numpy() for name in common},
        {name: reference[name].camera.viewmat.numpy() for name in common},
    )


def with_distance(solved: SolvedCalibration, first: str, second: str, *, metres: float) -> SolvedCalibration:
    """In metres, from the measured distance between the lenses of two cameras.

    Raises:
        CalibrationError: a distance that is not positive, or of cameras at one place.
    """
    one, other = (solved.cameras[name].camera.center.numpy() for name in (first, second))
    distance = float(np.linalg.norm(other - one))
    if not metres > 0 or distance == 0:
        raise CalibrationError(f"A distance of {metres:g} m between {first!r} and {second!r} gives no scale.")
    return solved.aligned(Alignment(metres / distance, np.eye(3), np.zeros(3)), metres=True)
