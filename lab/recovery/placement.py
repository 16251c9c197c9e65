# SPDX-License-Identifier: Apache-2.0
"""Where a recovered calibration is wrong in a way that a stream can see.

``python -m lab.recovery.placement PREPARED CAPTURE [--stream STREAM]`` compares a capture that ``structgstream
prepare`` wrote with the calibrated capture whose pictures were given to it. Errors of cameras after a similarity hold
what does no harm: a space that is bent a little is as good for a stream. So points of each camera's view are put where
the recovered cameras together say that they are, from exact projections, and each camera's distance to its own
projection is what remains: for all depths, and for things near it, where a wrong place cannot be made up for by a
rotation or a focal length. With a stream the held-out cameras are scored where they stand, and where an exact
calibration in the space of the recovered cameras has them: the difference is theirs, and no fault of the stream.
"""

import argparse
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.data.calibration import rotation_matrix
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.open import open_capture
from structgstream.data.prepared import read_prepared, write_prepared
from structgstream.preparation.calibration.solved import rig_alignment
from tests.support.calibration_errors import radius_of

Rig = Mapping[str, LensCamera]
Floats = NDArray[np.float64]

NEAR, ALL = (0.26, 0.53), (0.26, 1.7)  # depths, of the rig's radius
BORDER = 0.06  # of the picture
MIN_DEPTH = 0.1  # of the radius
ROUNDS = 4


def own_errors(estimate: Rig, truth: Rig, *, depths: tuple[float, float] = NEAR, count: int = 150) -> dict[str, float]:
    """By camera the median distance, pixels, between exact projections of points before it and what it shows of them.

    Args:
        estimate: the recovered cameras, which say where the points are.
        truth: the true ones.
        depths: of the points, of the rig's radius.
        count: of the points before each camera.
    """
    generator = np.random.default_rng(0)
    shown = {name: points_before(truth[name], generator, depths, count, radius_of(truth)) for name in estimate}
    found = {}
    for name, points in shown.items():
        moved = placed(points, estimate, truth)
        off = _misses(moved, points, {name: estimate[name]}, truth)[0]
        found[name] = float(np.nanmedian(np.linalg.norm(off, axis=1)))
    return found


def points_before(
    filmed: LensCamera, generator: np.random.Generator, depths: tuple[float, float], count: int, radius: float
) -> Floats:
    """Points ``[count, 3]`` in the view of a pinhole camera."""
    camera = filmed.camera
    size, K, viewmat = np.array([camera.width, camera.height]), camera.K.numpy(), camera.viewmat.numpy()
    pixels = generator.uniform(BORDER, 1 - BORDER, (count, 2)) * size
    rays = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(count)])
    local = rays * radius * generator.uniform(*depths, (count, 1))
    return (local - viewmat[:3, 3]) @ viewmat[:3, :3]


def placed(points: Floats, estimate: Rig, truth: Rig) -> Floats:
    """Where the cameras ``estimate`` together see true ``points``: least squares with Huber's loss of one pixel."""
    found = rig_alignment(truth, estimate).points(points).copy()
    step = 1e-5
    for _ in range(ROUNDS):
        off = _misses(found, points, estimate, truth)
        sides = [_misses(found + step * axis, points, estimate, truth) for axis in np.eye(3)]
        J = np.nan_to_num(np.stack([(side - off) / step for side in sides], -1))
        off = np.nan_to_num(off)
        weight = 1 / np.maximum(1, np.linalg.norm(off, axis=2))[..., None]
        normal = np.einsum("cpia,cpib->pab", J * weight[..., None], J) + 1e-9 * np.eye(3)
        right = np.einsum("cpia,cpi->pa", J * weight[..., None], off)
        found -= np.linalg.solve(normal, right[..., None])[..., 0]
    return found


def exactly_placed(name: str, estimate: Rig, truth: Rig) -> LensCamera:
    """The true camera ``name`` in the space of the others of ``estimate``, which may be bent a little."""
    from scipy.optimize import least_squares

    others = {other: filmed for other, filmed in estimate.items() if other != name}
    points = points_before(truth[name], np.random.default_rng(0), ALL, 600, radius_of(truth))
    moved = placed(points, others, truth)
    sure = np.isfinite(_misses(moved, points, others, truth)).all(2).sum(0) >= 3
    seen = truth[name].pixels(points)[sure]
    start = rig_alignment({other: truth[other] for other in others}, others).filmed(truth[name])

    def turned(change: Floats) -> LensCamera:
        viewmat, K = start.camera.viewmat.numpy().copy(), start.camera.K.numpy().copy()
        viewmat[:3, :3] = rotation_matrix(change[:3]) @ viewmat[:3, :3]
        viewmat[:3, 3] += change[3:6]
        K[[0, 1], [0, 1]] *= np.exp(change[6])
        K[:2, 2] += 10 * change[7:]
        return LensCamera(replace(start.camera, viewmat=torch.from_numpy(viewmat), K=torch.from_numpy(K)), Pinhole())

    found = least_squares(
        lambda change: np.nan_to_num(turned(change).pixels(moved[sure]) - seen).ravel(),
        np.zeros(9),
        loss="huber",
        f_scale=0.3,
    )
    return turned(found.x)


def _misses(found: Floats, points: Floats, estimate: Rig, truth: Rig) -> Floats:
    """Projections of ``found`` minus true ones of ``points``, ``[C, P, 2]``; NaN where a camera sees no point."""
    misses = np.full((len(estimate), len(points), 2), np.nan)
    least = MIN_DEPTH * radius_of(truth)
    for index, (name, filmed) in enumerate(estimate.items()):
        camera = truth[name].camera
        viewmat, pixels = camera.viewmat.numpy(), truth[name].pixels(points)
        seen = (points @ viewmat[2, :3] + viewmat[2, 3] > least) & (pixels >= 0).all(1)
        seen &= (pixels < [camera.width, camera.height]).all(1)
        misses[index, seen] = filmed.pixels(found[seen]) - pixels[seen]
    return misses


def held_out_scores(stream: Path, capture: Path, rig: Rig, truth: Rig, *, work: Path) -> dict[str, tuple[float, float]]:
    """By held-out camera the PSNR where it stands, and where it is exact in the space of the others.

    Args:
        stream: made from ``capture``.
        capture: a prepared one.
        rig: its cameras.
        truth: the true ones.
        work: folder for the capture with exact held-out cameras; replaced.
    """
    from structgstream.codec.reader import open_stream
    from structgstream.evaluation.evaluate import rendered
    from structgstream.evaluation.metrics import blackened
    from structgstream.evaluation.recording import capture_of
    from structgstream.kernels.backend import select_backend

    backend, reader = select_backend("auto"), open_stream(stream)
    names, header = reader.header.rig.testing, reader.header
    training = {name: filmed for name, filmed in rig.items() if name not in names}
    _write(capture, work, {name: exactly_placed(name, training, truth) for name in names})
    scores: dict[str, list[list[float]]] = {name: [[], []] for name in names}
    for which, folder in enumerate((capture, work)):
        source = capture_of(header, folder, frames=len(reader.packets))
        for frame, (_, scene) in zip(source.frames(), reader.scenes(0)):
            for name in names:
                picture = rendered(scene, header.camera(source.rig[name]), backend)[0]
                mask = frame.masks.get(name)
                both = [blackened(one, mask).astype(np.float64) for one in (picture, frame.images[name])]
                kept = 1.0 if mask is None else float(mask.mean())
                scores[name][which].append(-10 * np.log10(((both[0] - both[1]) ** 2).mean() / kept / 255**2))
    return {name: (float(np.mean(own)), float(np.mean(at))) for name, (own, at) in scores.items()}


def _write(capture: Path, folder: Path, cameras: Rig) -> None:
    """The prepared capture with some other cameras."""
    content = read_prepared(capture)
    shutil.rmtree(folder, ignore_errors=True)
    changed = dict(content.cameras)
    for name, filmed in cameras.items():
        pinhole = replace(changed[name].pinhole, viewmat=filmed.camera.viewmat)
        changed[name] = replace(changed[name], filmed=filmed, pinhole=pinhole)
    for camera in changed.values():
        (folder / camera.files).parent.mkdir(parents=True, exist_ok=True)
        (folder / camera.files).symlink_to((capture / camera.files).resolve())
    write_prepared(folder, replace(content, cameras=changed, points=None))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m lab.recovery.placement", description=__doc__)
    parser.add_argument("prepared", type=Path, help="what structgstream prepare wrote")
    parser.add_argument("capture", type=Path, help="the calibrated capture of the same cameras, without distortion")
    parser.add_argument("--stream", type=Path, help="made from PREPARED")
    parser.add_argument("--work", type=Path, default=Path("build/placement"), help="folder for an exact capture")
    options = parser.parse_args(arguments)
    given = open_capture(options.capture).rig
    estimate = {name: camera.filmed for name, camera in read_prepared(options.prepared).cameras.items()}
    truth = {name: LensCamera(given[name], Pinhole()) for name in estimate}
    for title, depths in (("near", NEAR), ("all depths", ALL)):
        errors = own_errors(estimate, truth, depths=depths)
        values = list(errors.values())
        told = ", ".join(f"{name} {error:.1f}" for name, error in errors.items())
        print(f"{title}: median {np.median(values):.2f}, mean {np.mean(values):.2f} pixels ({told})")
    if options.stream:
        for name, (own, exact) in held_out_scores(
            options.stream, options.prepared, estimate, truth, work=options.work
        ).items():
            print(f"camera {name}: {own:.2f} dB where it stands, {exact:.2f} dB where it is exact")


if __name__ == "__main__":
    main()
