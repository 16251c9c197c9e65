# SPDX-License-Identifier: Apache-2.0
"""Renders a clip: ``python lab/clip/scene.py table build/clip`` writes one PNG per camera and frame.

Pictures that exist are skipped, so a run that was stopped goes on where it ended.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

mi.set_variant("llvm_ad_rgb")

import mitsuba_oidn  # noqa: E402  (needs the variant)
from materials import lights, shape  # noqa: E402
from meshes import Parts  # noqa: E402
from rig import FIELD_OF_VIEW_DEGREES, FPS, FRAMES, RIGS, Rig, View  # noqa: E402
from table.stage import TABLE  # noqa: E402
from throw.stage import THROW  # noqa: E402
from tone import developed  # noqa: E402

STAGES = {"n3dv": TABLE, "table": TABLE, "throw": THROW}


def shapes(parts: Parts, surfaces: dict[str, Any]) -> dict[str, Any]:
    """Mitsuba shapes of named meshes."""
    return {name: shape(name, mesh, surfaces[surface]) for name, (mesh, surface) in parts.items()}


def sensor(view: View, rig: Rig) -> Any:
    """The view as a Mitsuba camera; the box filter keeps pixels independent, as the denoiser expects."""
    to_world = mi.ScalarTransform4f().look_at(origin=view.eye.tolist(), target=list(rig.target), up=[0, 0, 1])
    film = {
        "type": "hdrfilm",
        "width": rig.width,
        "height": rig.height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
    }
    return mi.load_dict({
        "type": "perspective", "fov": FIELD_OF_VIEW_DEGREES, "fov_axis": "x",
        "near_clip": 0.02, "far_clip": 20.0,
        "to_world": to_world, "film": film, "sampler": {"type": "independent"},
    })  # fmt: skip


def rendered(scene: Any, camera: Any, *, samples: int, guide_samples: int, seed: int) -> np.ndarray:
    """Linear RGB ``[H, W, 3]``, path traced and denoised with albedo and normals as guides."""
    path = mi.load_dict({"type": "path", "max_depth": 7, "rr_depth": 4})
    guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    color = np.array(mi.render(scene, integrator=path, sensor=camera, spp=samples, seed=seed))[..., :3]
    guide = np.array(mi.render(scene, integrator=guides, sensor=camera, spp=guide_samples, seed=seed))
    albedo, normal = np.clip(guide[..., -6:-3], 0, 1), guide[..., -3:]
    parts = [np.ascontiguousarray(part, np.float32) for part in (color, albedo, normal)]
    return np.array(mitsuba_oidn.denoise(*parts, hdr=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", choices=sorted(RIGS))
    parser.add_argument("out", type=Path, help="folder for the pictures")
    parser.add_argument("--frames", type=int, nargs="*", default=list(range(FRAMES)))
    parser.add_argument("--cameras", type=int, nargs="*", help="default: all")
    parser.add_argument("--samples", type=int, default=48, help="a pixel, training cameras")
    parser.add_argument("--held-out-samples", type=int, default=160, help="a pixel, camera 0")
    parser.add_argument("--guide-samples", type=int, default=16, help="a pixel, albedo and normals for the denoiser")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rig, stage = RIGS[options.scene], STAGES[options.scene]
    views, surfaces = rig.views(), stage.surfaces()
    numbers = range(len(views)) if options.cameras is None else options.cameras
    light = lights(size=stage.lights_size, panel=stage.panel, window=stage.window)
    still = shapes(stage.still(), surfaces) | {name: mi.load_dict(part) for name, part in light.items()}
    cameras = {number: sensor(views[number], rig) for number in numbers}
    for frame in options.frames:
        missing = {
            number: path
            for number in numbers
            if not (path := options.out / f"{views[number].name}_{frame:02d}.png").exists()
        }
        if not missing:
            continue
        scene = mi.load_dict({"type": "scene"} | still | shapes(stage.moving(frame / FPS), surfaces))
        for number, path in missing.items():
            start = time.perf_counter()
            samples = options.held_out_samples if number == 0 else options.samples
            linear = rendered(
                scene, cameras[number], samples=samples, guide_samples=options.guide_samples, seed=1000 * frame + number
            )
            Image.fromarray(developed(linear)).save(path)
            print(f"{path.name}: {time.perf_counter() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
