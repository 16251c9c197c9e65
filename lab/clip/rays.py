# SPDX-License-Identifier: Apache-2.0
"""Renders along given rays, whatever lens they belong to: ``python lab/clip/rays.py table build/rigs``.

Each ``rays/VIEW.npz`` of the folder has ``eye [3]`` (metres), ``corners [H + 1, W + 1, 3]``, the directions through the
corners of the pixels (zero where the lens shows nothing), and ``seconds [S]``, times of the scene. The picture of its
``NN``-th time becomes ``light/VIEW_NN.npy``, linear RGB ``[H, W, 3]`` float16. Pictures that exist are skipped.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zlib import crc32

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

mi.set_variant("llvm_ad_rgb")

import drjit as dr  # noqa: E402  (needs the variant)
import mitsuba_oidn  # noqa: E402
from materials import lights  # noqa: E402
from scene import STAGES, shapes  # noqa: E402


def rays(eye: NDArray[np.float64], corners: NDArray[np.float32], *, samples: int, sampler: Any) -> Any:
    """``samples`` jittered rays a pixel, pixel after pixel, with directions interpolated between the pixel's corners.

    A lens is smooth: over one pixel of the widest lens here that is wrong by less than a thousandth of a pixel.
    """
    height, width = corners.shape[0] - 1, corners.shape[1] - 1
    pixel = dr.arange(mi.UInt32, height * width * samples) // samples
    first = pixel // width * (width + 1) + pixel % width
    grid = mi.Vector3f(np.ascontiguousarray(corners.reshape(-1, 3).T))
    jitter = sampler.next_2d()
    a, b, c, d = (dr.gather(mi.Vector3f, grid, first + step) for step in (0, 1, width + 1, width + 2))
    towards = dr.lerp(dr.lerp(a, b, jitter.x), dr.lerp(c, d, jitter.x), jitter.y)
    shown = dr.squared_norm(a) * dr.squared_norm(b) * dr.squared_norm(c) * dr.squared_norm(d) > 0
    return mi.RayDifferential3f(mi.Point3f(*eye.tolist()), dr.normalize(dr.select(shown, towards, [0, 0, 1]))), shown


def rendered(
    scene: Any, eye: NDArray[np.float64], corners: NDArray[np.float32], *, samples: int, guide_samples: int, seed: int
) -> NDArray[np.float32]:
    """Linear RGB ``[H, W, 3]``, path traced and denoised with albedo and normals as guides."""
    height, width = corners.shape[0] - 1, corners.shape[1] - 1

    def shot(count: int, number: int) -> tuple[Any, Any, Any]:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(number, height * width * count)
        return sampler, *rays(eye, corners, samples=count, sampler=sampler)

    def means(values: Any, count: int) -> NDArray[np.float32]:
        flat = np.array(dr.block_sum(dr.ravel(values), 1)).reshape(height, width, count, -1)
        return flat.mean(2, dtype=np.float32)

    sampler, beams, shown = shot(samples, seed)
    path = mi.load_dict({"type": "path", "max_depth": 7, "rr_depth": 4})
    color = means(mi.Vector3f(path.sample(scene, sampler, beams)[0]) & shown, samples)
    _, beams, shown = shot(guide_samples, seed + 1_000_000)
    hit = scene.ray_intersect(beams)
    albedo = means(mi.Vector3f(hit.bsdf().eval_diffuse_reflectance(hit, hit.is_valid() & shown)), guide_samples)
    normal = means(mi.Vector3f(hit.sh_frame.n) & (hit.is_valid() & shown), guide_samples)
    parts = [np.ascontiguousarray(part, np.float32) for part in (color, np.clip(albedo, 0, 1), normal)]
    return np.array(mitsuba_oidn.denoise(*parts, hdr=True))


def missing(folder: Path, views: str) -> Iterator[tuple[float, int, Path, Path]]:
    """Time, seed, file of rays and file to write of every picture that does not exist, in the order of time."""
    wanted = []
    for file in sorted((folder / "rays").glob(f"{views}.npz")):
        for step, seconds in enumerate(np.load(file)["seconds"]):
            path = folder / "light" / f"{file.stem}_{step:02d}.npy"
            if not path.exists():
                wanted.append((float(seconds), crc32(path.name.encode()) % 10**6, file, path))
    yield from sorted(wanted)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=sorted(STAGES))
    parser.add_argument("folder", type=Path, help="with rays/, for light/")
    parser.add_argument("--views", default="*", help="which, as a pattern of names")
    parser.add_argument("--samples", type=int, default=8, help="a pixel")
    parser.add_argument("--guide-samples", type=int, default=12, help="a pixel, albedo and normals for the denoiser")
    parser.add_argument("--at-most", type=int, help="pictures; for a trial")
    options = parser.parse_args()
    (options.folder / "light").mkdir(parents=True, exist_ok=True)
    stage = STAGES[options.scene]
    surfaces = stage.surfaces()
    light = lights(size=stage.lights_size, panel=stage.panel, window=stage.window)
    still = shapes(stage.still(), surfaces) | {name: mi.load_dict(part) for name, part in light.items()}
    scene, at = None, -1.0
    for done, (seconds, seed, file, path) in enumerate(missing(options.folder, options.views)):
        if done == options.at_most:
            break
        start = time.perf_counter()
        if scene is None or seconds != at:
            scene, at = mi.load_dict({"type": "scene"} | still | shapes(stage.moving(seconds), surfaces)), seconds
        view = np.load(file)
        linear = rendered(
            scene, view["eye"], view["corners"], samples=options.samples, guide_samples=options.guide_samples, seed=seed
        )
        part = path.with_suffix(".part")
        with part.open("wb") as stream:
            np.save(stream, np.clip(linear, 0, 60000).astype(np.float16))
        part.rename(path)  # A picture that has its name is whole.
        print(f"{path.name}: {time.perf_counter() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
