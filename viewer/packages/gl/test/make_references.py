# SPDX-License-Identifier: Apache-2.0
"""Pictures and MLP outputs of a stream as the CPU back-end has them: what the browser's are held to.

``python viewer/packages/gl/test/make_references.py STREAM FOLDER`` writes, for held-out cameras, at other sizes,
nearer, and on an arc, PNGs, the outputs of the MLPs of some Gaussians, and ``views.json``, which names both.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from structgstream.cameras import Camera, CameraRig
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.evaluation.camera_path import arc, focus_point, free_near
from structgstream.evaluation.evaluate import rendered
from structgstream.evaluation.pictures import write_png
from structgstream.kernels.backend import Backend, select_backend
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene

SIZES = (0.25, 0.5, 3.0)  # of the pictures that the stream was trained with
HELD_OUT = 4  # cameras, at most
COLUMNS = 11  # opacity, rgb, share of the largest scale (3), quaternion (4)


def numbers_of(camera: Camera) -> dict[str, Any]:
    """The camera as the renderer takes it, in the scene's units."""
    K = camera.K
    return {
        "viewmat": camera.viewmat.reshape(-1).tolist(),
        "K": {"fx": float(K[0, 0]), "fy": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])},
        "width": camera.width,
        "height": camera.height,
        "near": camera.near,
    }


def outputs_of(scene: Scene, camera: Camera, backend: Backend, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Ids ``[n]`` of up to ``most`` structured Gaussians that are drawn, and what the MLPs say of them ``[n, 11]``."""
    structured = scene.structured(camera, backend)
    generated = structured.gaussians
    drawn = draw(scene.with_free_gaussians(structured), camera, backend).radii[: len(generated.ids)].nonzero()[:, 0]
    rows = drawn[:: max(1, -(-len(drawn) // most))]
    ids = generated.ids[rows]
    shares = generated.scales[rows] / scene.anchors.log_base_scales[ids // scene.anchors.offsets_per_anchor].exp()
    values = torch.cat([generated.opacities[rows, None], generated.colors[rows], shares, generated.quats[rows]], dim=1)
    return ids.numpy().astype("<u4"), values.numpy().astype("<f4")


def nearer(camera: Camera, rig: CameraRig) -> Camera:
    """``camera`` half way to what its picture has in the middle, where the rig looks at (capture's units)."""
    middle = torch.tensor([camera.width / 2, camera.height / 2, 1.0], dtype=torch.float64)
    depth = (focus_point(rig) - camera.center) @ camera.viewmat[2, :3]
    eye = camera.center + 0.5 * depth * (camera.viewmat[:3, :3].T @ torch.linalg.solve(camera.K, middle))
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return replace(camera, viewmat=viewmat, near=free_near(rig, eye))


def views_of(reader: StreamReader, *, frames: list[int] | None, on_arc: int) -> list[tuple[str, int, Camera]]:
    """Name, frame and camera (capture's units) of every picture: held-out cameras, the first of them at
    other sizes and from half the distance, and an arc on which time runs."""
    rig, count = reader.header.rig, len(reader.packets)
    chosen = [0, count // 2, count - 1] if frames is None else frames
    views = [
        (f"camera-{name}-{frame}", frame, rig[name])
        for name in rig.testing[:HELD_OUT]
        for frame in dict.fromkeys(chosen)
    ]
    for name in rig.testing[:1]:
        camera = rig[name]
        for size in SIZES:
            small = camera.resized(round(size * camera.width), round(size * camera.height))
            views.append((f"size-{size:g}-{chosen[0]}", chosen[0], small))
        views.append((f"nearer-{chosen[0]}", chosen[0], nearer(camera, rig)))
    for number, camera in enumerate(arc(rig, on_arc)):
        frame = round(number * (count - 1) / max(on_arc - 1, 1))
        views.append((f"arc-{number}-{frame}", frame, camera))
    return views


def main() -> None:
    """Writes the references of one stream."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stream", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, nargs="*", help="of held-out cameras; default: first, middle, last")
    parser.add_argument("--arc", type=int, default=5, help="how many cameras on the arc")
    parser.add_argument("--outputs", type=int, default=2000, help="how many Gaussians' MLP outputs a view")
    options = parser.parse_args()
    reader, backend = open_stream(options.stream), select_backend("cpu")
    options.folder.mkdir(parents=True, exist_ok=True)
    entries: list[dict[str, Any]] = []
    outputs = b""
    for name, frame, camera in views_of(reader, frames=options.frames, on_arc=options.arc):
        scene, view = reader.scene(frame), reader.header.similarity.camera(camera)
        write_png(options.folder / f"{name}.png", rendered(scene, view, backend)[0])
        ids, values = outputs_of(scene, view, backend, options.outputs)
        entry = {"name": name, "frame": frame, "camera": numbers_of(view), "outputs": len(ids), "offset": len(outputs)}
        outputs += ids.tobytes() + values.tobytes()
        entries.append(entry)
    (options.folder / "outputs.bin").write_bytes(outputs)
    (options.folder / "views.json").write_text(json.dumps({"columns": COLUMNS, "views": entries}) + "\n")


if __name__ == "__main__":
    main()
