# SPDX-License-Identifier: Apache-2.0
"""What tone curves are worth: ``python tools/tone/measure.py build/tone --preset fast --frames 3``.

Gives each training camera of the bundled clip a gamma and a contrast of its own, estimates curves from keypoints
matched on frame 0 (known poses), reconstructs the clip as it is, as filmed so, and through the curves, and prints the
scores at the held-out camera, whose pictures stay as they are.
"""

import argparse
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import structgstream
from structgstream.data.clip import bundled_clip
from structgstream.data.matching import guided_matches, neighbor_views, sift_features, unique_pairs, viewing_distance
from structgstream.data.source import FrameSource
from structgstream.data.tone import basis, toned
from structgstream.data.wrappers import SourceWrapper, section
from structgstream.frames import MultiViewFrame
from structgstream.preparation.tone import ToneEstimate, estimate_tones, sample_colors
from structgstream.preparation.tone_fit import curve_towards, slopes

GAMMAS, CONTRASTS, CASTS = 0.2, 0.25, 0.04
"""Largest logarithm of a camera's gamma, largest contrast, largest logarithm of a channel's own gamma."""


@dataclass(frozen=True)
class Filmed(SourceWrapper):
    """Pictures through tables ``[256, 3]`` of their cameras."""

    tables: Mapping[str, NDArray[np.uint8]]

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for frame in self.source.frames(start):
            images = {
                name: self.tables[name][image, np.arange(3)] if name in self.tables else image
                for name, image in frame.images.items()
            }
            yield replace(frame, images=images)


@dataclass(frozen=True)
class Matches:
    """Matched keypoints as tracks of two."""

    point: NDArray[np.int64]
    camera: NDArray[np.int64]
    pixels: NDArray[np.float64]
    instant: NDArray[np.int64]


def tables(names: tuple[str, ...], *, strength: float, seed: int) -> dict[str, NDArray[np.uint8]]:
    """A gamma and a contrast for each camera."""
    g = np.random.default_rng(seed)
    found = {}
    for name in names:
        gamma = np.exp(strength * (g.uniform(-GAMMAS, GAMMAS) + g.uniform(-CASTS, CASTS, 3)))
        level = (np.arange(256)[:, None] / 255) ** gamma
        level = level - strength * g.uniform(-CONTRASTS, CONTRASTS) * np.sin(2 * np.pi * level) / (2 * np.pi)
        found[name] = np.rint(level * 255).clip(0, 255).astype(np.uint8)
    return found


def matched(source: FrameSource) -> tuple[Matches, dict[str, list[NDArray[np.uint8]]]]:
    """Keypoints of frame 0 that pairs of cameras share by their poses, and the pictures."""
    rig, frame = source.rig, next(source.frames())
    cameras = {name: rig[name] for name in rig.training}
    distance = viewing_distance(cameras)
    features = {name: sift_features(frame.images[name], count=4000) for name in cameras}
    names = list(cameras)
    point, camera, pixels = [], [], []
    for pair in unique_pairs(neighbor_views(cameras, count=6, distance=distance)):
        first, second = pair
        both = (cameras[first], cameras[second])
        limits = (0.2 * distance, 4 * distance)
        found = guided_matches(features[first], features[second], both, line_pixels=1.5, depth_range=limits, ratio=0.8)
        start = len(point) // 2
        for side, name in enumerate(pair):
            point += range(start, start + len(found))
            camera += [names.index(name)] * len(found)
            pixels.append(features[name].pixels[found[:, side]])
    instant = np.zeros(len(point), np.int64)
    tracks = Matches(np.array(point), np.array(camera), np.concatenate(pixels), instant)
    return tracks, {name: [frame.images[name]] for name in names}


def estimated(source: FrameSource) -> ToneEstimate:
    """The curves of a capture's training cameras."""
    tracks, pictures = matched(source)
    names = tuple(pictures)
    return estimate_tones(sample_colors(pictures, tracks, cameras=names), cameras=names)


def psnr_camera_curve(stream: Path, clip: FrameSource) -> float:
    """PSNR at the held-out camera through the curve of each channel that its frame 0 gives.

    The common tone of cameras that differ is none of theirs, and a gain and a bias do not lead from it to another.
    """
    (name,) = clip.rig.testing
    reader = structgstream.open_stream(stream)
    controls, errors = [], []
    for index, frame in enumerate(clip.frames()):
        truth, picture = frame.images[name] / 255, np.asarray(reader.render(index, name))
        if not controls:
            pairs = [(picture[..., k].ravel() / 255, truth[..., k].ravel()) for k in range(3)]
            controls = [curve_towards(values, targets, free=slopes()) for values, targets in pairs]
        levels = basis(np.arange(256) / 255)
        mapped = np.stack([(levels @ own)[picture[..., k]] for k, own in enumerate(controls)], -1).clip(0, 1)
        errors.append(-10 * np.log10(((mapped - truth) ** 2).mean()))
    return float(np.mean(errors))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--strength", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    clip = section(bundled_clip(), frames=options.frames)
    filmed = Filmed(clip, tables(clip.rig.training, strength=options.strength, seed=options.seed))
    estimate = estimated(filmed)
    print("mean difference of a point's colours between cameras, of 255:", asdict(estimate.errors), flush=True)
    options.output.mkdir(parents=True, exist_ok=True)
    results = {}
    for case, source in {"as it is": clip, "filmed": filmed, "curves": toned(filmed, estimate.curves)}.items():
        stream = options.output / f"{case.replace(' ', '-')}.sgs"
        structgstream.reconstruct(source, stream, preset=options.preset, overwrite=True)
        mean = structgstream.evaluate(stream, source, metrics="basic").mean
        results[case] = {
            "psnr": mean.psnr,
            "psnr_camera_color": mean.psnr_camera_color,
            "psnr_camera_curve": psnr_camera_curve(stream, clip),
            "ssim": mean.ssim,
        }
        print(case, results[case], flush=True)
    facts = {"errors": asdict(estimate.errors), "results": results, **{k: str(v) for k, v in vars(options).items()}}
    (options.output / "tone.json").write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
