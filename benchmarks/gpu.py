# SPDX-License-Identifier: Apache-2.0
"""What there is to know on a machine with a GPU, in under six minutes: ``python -m benchmarks.gpu OUT.json``.

Each part prints its figures and what was predicted without a GPU, and writes all figures so far; a part that fails
is reported and the next one begins. gsplat is a second opinion on the rasteriser, where it is installed.
"""

import argparse
import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.stages import mapped
from benchmarks.world import World, fitted, held_out_psnr, wall_world
from structgstream.cameras import Camera, Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels import cpu_fit
from structgstream.kernels.backend import Backend, cpu_backend, cuda_backend
from structgstream.kernels.values import FitFrame, Rasterizer, RasterOutput
from structgstream.scene.render import render_picture
from structgstream.scene.state import on_device
from structgstream.session.presets import COMPACT
from structgstream.training.result import FitResult

BUDGET_SECONDS = 330.0
SIZES = {
    "640x360, 27 cameras": {"anchors": 25_000, "width": 640, "height": 360, "cameras": 27},
    "1352x1014, 20 cameras": {"anchors": 25_000, "width": 1352, "height": 1014, "cameras": 20},
}
PREDICTED: Mapping[str, str] = {
    "picture error": "under 1e-5 at most",
    "picture with gradients, ms": "1 at 640x360, 3 at 1352x1014",
    "picture error of 99.9 %": "under 1e-5",
    "picture error of gsplat, 99.9 %": "under 1e-4",
    "gradient error of gsplat": "under 0.02, since it has gradients behind opaque surfaces",
    "gradient error": "under 1e-3",
    "equal bits": "True",
    "iteration, ms": "0.25 at 640x360, 0.9 at 1352x1014",
    "frame, s": "0.8 at 640x360 (goal of the design 0.3), 2 at 1352x1014 (goal 0.7)",
    "frame in torch, s": "1.2 at 640x360 (recorded, with gsplat, 1.4 on an H100)",
    "pictures a second": "600 at 640x360, 400 at 1352x1014",
    "frame 0 of the clip, s": "20",
    "racecheck": "0 hazards",
}


def moved(value: Any, device: torch.device) -> Any:
    """``value`` with copies of its tensors on ``device``."""
    return mapped(value, lambda tensor: tensor.detach().to(device, copy=True))


def copied(frame: FitFrame, device: torch.device) -> FitFrame:
    """The frame on ``device``, with its plan where the host reads it."""
    return moved(frame, device)._replace(plan=moved(frame.plan, torch.device("cpu")))


ATTRIBUTES = ("means", "quats", "scales", "opacities", "colors")


def drawn_with_gradients(rasterize: Rasterizer, gaussians: Gaussians, camera: Camera) -> list[Tensor]:
    """The picture, its coverage, and the gradients of ``gaussians`` for a ramp over the picture."""
    columns = gaussians.columns()
    leaves = {name: columns[name].detach().clone().requires_grad_() for name in ATTRIBUTES}
    output = rasterize(replace(gaussians, **leaves), camera.viewport(gaussians.means))
    ramp = torch.linspace(-1.0, 1.0, output.image.numel(), device=output.image.device).reshape(output.image.shape)
    total = (output.image * ramp).sum() + output.alpha.mean()
    return [output.image.detach(), output.alpha.detach(), *torch.autograd.grad(total, list(leaves.values()))]


def rasterize_by_gsplat(gaussians: Gaussians, viewport: Viewport) -> RasterOutput:
    """See ``reference_raster.rasterize``; without extents."""
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    images, alphas, _ = rasterization(
        *(getattr(gaussians, name) for name in ATTRIBUTES),
        *(viewport.viewmat[None], viewport.K[None], viewport.width, viewport.height),
        near_plane=viewport.near,
        packed=False,
    )
    return RasterOutput(images[0], alphas[0, ..., 0], torch.zeros_like(gaussians.opacities))


def apart(ours: Sequence[Tensor], theirs: Sequence[Tensor]) -> tuple[float, float]:
    """Error of a picture and its coverage that a thousandth of the numbers exceeds (the last bit decides whether an
    alpha is at its limit), and the largest relative one of a gradient.
    """
    pairs = [(a.cpu(), b.cpu()) for a, b in zip(ours, theirs, strict=True)]
    errors = [float((a - b).abs().flatten().quantile(0.999)) for a, b in pairs[:2]]
    return max(errors), max(float((a - b).norm() / b.norm().clamp(min=1e-30)) for a, b in pairs[2:])


class _Captured(Exception):
    """Ends a fit when its iterations would begin."""


def fit_frame(world: World, backend: Backend) -> FitFrame:
    """What the iterations of a frame of ``world`` begin with."""
    found: list[FitFrame] = []

    def begin(frame: FitFrame) -> Callable[[int, int], None]:
        found.append(frame)
        raise _Captured

    try:
        fitted(world, replace(backend, iterations=begin), COMPACT.online)
    except _Captured:
        return found[0]
    raise AssertionError("the frame is fitted in torch")


@dataclass
class Measurement:
    """A machine's GPU, as a back-end.

    Args:
        backend: with iterations of its own.
        sizes: of the worlds, by title.
        waits: ends when the device has done all that was queued.
    """

    backend: Backend
    sizes: Mapping[str, Mapping[str, int]]
    waits: Callable[[], object]

    def __post_init__(self) -> None:
        self.worlds = {title: wall_world(cpu_backend(), **size, share=0.16) for title, size in self.sizes.items()}

    def begin(self, frame: FitFrame) -> Callable[[int, int], None]:
        assert self.backend.iterations is not None, "the kernels were not compiled"
        return self.backend.iterations(frame)

    def seconds(self, work: Callable[[], object]) -> float:
        self.waits()
        started = time.perf_counter()
        work()
        self.waits()
        return time.perf_counter() - started

    def rasteriser(self) -> dict[str, Any]:
        """A picture with gradients on the GPU, on the processor, and by gsplat."""
        found = {}
        for title, world in self.worlds.items():
            camera = next(iter(world.rig.cameras.values()))
            gaussians = world.before.gaussians(camera, cpu_backend())
            there = moved(gaussians, self.backend.device)
            draw = partial(drawn_with_gradients, self.backend.rasterize, there, camera)
            ours, again = draw(), draw()
            picture, gradient = apart(ours, drawn_with_gradients(cpu_backend().rasterize, gaussians, camera))
            figures: dict[str, Any] = {
                "Gaussians": len(gaussians),
                "picture error of 99.9 %": picture,
                "gradient error": gradient,
                "equal bits": all(map(torch.equal, ours, again)),
                "picture with gradients, ms": self.median_milliseconds(draw),
            }
            if self.backend.device.type == "cuda" and importlib.util.find_spec("gsplat") is not None:
                draw = partial(drawn_with_gradients, rasterize_by_gsplat, there, camera)
                figures["picture error of gsplat, 99.9 %"], figures["gradient error of gsplat"] = apart(ours, draw())
                figures["by gsplat, ms"] = self.median_milliseconds(draw)
            found[title] = figures
        return found

    def median_milliseconds(self, work: Callable[[], object]) -> float:
        return 1e3 * sorted(self.seconds(work) for _ in range(9))[4]

    def correctness(self) -> dict[str, Any]:
        """An iteration of some views on the GPU and on the processor; all iterations twice."""
        device, here, found = self.backend.device, torch.device("cpu"), {}
        for title, world in self.worlds.items():
            frame, errors = fit_frame(world, self.backend), []
            for i in range(min(4, len(frame.plan.order))):
                one, two = copied(frame, device), copied(frame, here)
                self.begin(one)(i, i + 1)
                cpu_fit.iterations(two)(i, i + 1)
                number = int(frame.plan.order[i])
                picture = (one.views[number].image.cpu() - two.views[number].image).abs()
                gradients = [
                    float((a.first.cpu() - b.first).norm() / b.first.norm().clamp(min=1e-30))
                    for a, b in zip(one.leaves, two.leaves, strict=True)
                    if a is not None and b is not None and a.first is not None and b.first is not None
                ]
                errors.append((float(picture.max()), float(picture.mean()), max(gradients)))
            runs = [copied(frame, device) for _ in range(2)]
            for run in runs:
                self.begin(run)(0, len(run.plan.order))
            found[title] = {
                "picture error": max(error[0] for error in errors),
                "mean picture error": max(error[1] for error in errors),
                "gradient error": max(error[2] for error in errors),
                "equal bits": all(
                    torch.equal(a.values, b.values)
                    for a, b in zip(runs[0].leaves, runs[1].leaves, strict=True)
                    if a is not None and b is not None
                ),
            }
        return found

    def iterations(self) -> dict[str, Any]:
        """Milliseconds of an iteration, and of each of its kernels."""
        found: dict[str, Any] = {}
        for title, world in self.worlds.items():
            frame = fit_frame(world, self.backend)
            count = len(frame.plan.order)
            runs = [self.begin(copied(frame, self.backend.device)) for _ in range(5)]
            times = sorted(self.seconds(partial(run, 0, count)) for run in runs)
            found[title] = {"iteration, ms": 1e3 * times[len(times) // 2] / count, "iterations": count}
            if self.backend.device.type == "cuda":
                found[title]["microseconds of kernels in an iteration"] = self.kernels(frame)
        return found

    def kernels(self, frame: FitFrame) -> dict[str, float]:
        count, run = len(frame.plan.order), self.begin(copied(frame, self.backend.device))
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
            run(0, count)
            self.waits()
        return {row.key[:90]: row.self_device_time_total / count for row in profile.key_averages()}

    def frames(self) -> dict[str, Any]:
        """A whole online frame with the native iterations."""
        return {title: self.frame("frame, s", world, self.backend) for title, world in self.worlds.items()}

    def frames_in_torch(self) -> dict[str, Any]:
        """The same with iterations in torch."""
        backend = replace(self.backend, iterations=None)
        return {title: self.frame("frame in torch, s", world, backend) for title, world in self.worlds.items()}

    def frame(self, name: str, world: World, backend: Backend) -> dict[str, Any]:
        fits: list[FitResult] = []
        times = [self.seconds(lambda: fits.append(fitted(world, backend, COMPACT.online))) for _ in range(3)]
        scene = on_device(fits[-1].scene, torch.device("cpu"))
        return {
            name: min(times),
            "first, s": times[0],
            "stages": dict(fits[-1].seconds),
            "held-out PSNR, dB": held_out_psnr(scene, world, cpu_backend()),
        }

    def pictures(self) -> dict[str, Any]:
        """Pictures a second, from the scene to bytes in the host's memory."""
        found = {}
        for title, world in self.worlds.items():
            scene, cameras = on_device(world.before, self.backend.device), list(world.rig.cameras.values())

            def draw(scene: Any = scene, cameras: Sequence[Any] = cameras) -> None:
                for camera in cameras:
                    render_picture(scene, camera, self.backend)

            draw()
            found[title] = {"pictures a second": len(cameras) / self.seconds(draw)}
        return found

    def clip(self) -> dict[str, Any]:
        """The bundled clip: frame 0 and three more."""
        import structgstream
        from structgstream.data.dataset_layouts import bundled_clip_path

        with tempfile.TemporaryDirectory() as folder:
            path, config = Path(folder) / "clip.sgs", {"preset": "compact", "backend": self.backend}
            first = self.seconds(lambda: structgstream.reconstruct(bundled_clip_path(), path, frames=1, **config))
            path.unlink()
            all_four = self.seconds(lambda: structgstream.reconstruct(bundled_clip_path(), path, frames=4, **config))
            psnr = structgstream.evaluate(path, bundled_clip_path(), metrics="basic", backend=self.backend).mean.psnr
        return {"frame 0 of the clip, s": first, "four frames, s": all_four, "held-out PSNR, dB": psnr}


def racecheck(seconds: float) -> dict[str, Any]:
    """NVIDIA's check for missing barriers, of one iteration and one picture with gradients of a small world."""
    tool = shutil.which("compute-sanitizer") or "/usr/local/cuda/bin/compute-sanitizer"
    command = [tool, "--tool", "racecheck", sys.executable, "-m", "benchmarks.gpu", "--one-iteration"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    return {"racecheck": (done.stdout + done.stderr).strip().splitlines()[-1:], "status": done.returncode}


def machine() -> dict[str, Any]:
    """The GPU, torch, and the seconds that compiling the kernels takes, or that their cache took."""
    from structgstream.kernels.cuda_library import kernel_library

    started = time.perf_counter()
    kernel_library()
    return {
        "GPU": torch.cuda.get_device_name(),
        "torch": torch.__version__,
        "compiled in, s": time.perf_counter() - started,
    }


def show(name: str, figures: Mapping[str, Any]) -> None:
    """Print figures and their predictions."""
    for key, value in figures.items():
        if isinstance(value, Mapping) and not key.endswith(("stages", "in an iteration")):
            show(f"{name}, {key}", value)
            continue
        predicted = f"   (predicted: {PREDICTED[key]})" if key in PREDICTED else ""
        print(f"{name}: {key}: {value}{predicted}", flush=True)


def measured(parts: Mapping[str, Callable[[], dict[str, Any]]], out: Path, *, until: float) -> dict[str, Any]:
    """Run the parts until that time; ``out`` has the figures of all that ended."""
    found: dict[str, Any] = {}
    for name, part in parts.items():
        if time.perf_counter() > until:
            found[name] = {"skipped": "no time left"}
        else:
            started = time.perf_counter()
            try:
                found[name] = part()
            except Exception as error:
                found[name] = {"failed": f"{type(error).__name__}: {error}"}
            found[name]["seconds of this part"] = time.perf_counter() - started
        out.write_text(json.dumps(found, indent=2, default=str) + "\n")
        show(name, found[name])
    return found


def main() -> None:
    """Measure this machine's GPU."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("out", type=Path, nargs="?", help="JSON with all figures")
    parser.add_argument("--one-iteration", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    small = {"small": {"anchors": 2_000, "width": 160, "height": 96, "cameras": 3}}
    if options.one_iteration:
        measurement = Measurement(cuda_backend(), small, torch.cuda.synchronize)
        world, backend = measurement.worlds["small"], measurement.backend
        measurement.begin(fit_frame(world, backend))(0, 1)
        scene, camera = on_device(world.before, backend.device), next(iter(world.rig.cameras.values()))
        drawn_with_gradients(backend.rasterize, scene.gaussians(camera, backend), camera)
        return
    if options.out is None:
        parser.error("name the file to write")
    until = time.perf_counter() + BUDGET_SECONDS
    first = measured({"machine": machine}, options.out, until=until)
    measurement = Measurement(cuda_backend(), SIZES, torch.cuda.synchronize)
    parts = {
        "machine": lambda: first["machine"],
        "rasteriser": measurement.rasteriser,
        "correctness": measurement.correctness,
        "iterations": measurement.iterations,
        "pictures": measurement.pictures,
        "frames": measurement.frames,
        "racecheck": lambda: racecheck(max(10.0, min(80.0, until - time.perf_counter()))),
        "frames in torch": measurement.frames_in_torch,
        "clip": measurement.clip,
    }
    measured(parts, options.out, until=until)


if __name__ == "__main__":
    main()
