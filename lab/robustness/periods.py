# SPDX-License-Identifier: Apache-2.0
"""A scene that becomes another one in the middle of a stream: with and without another period.

``python -m lab.robustness.periods FOLDER --case recoloured --variant scene`` makes the stream of one variant, and goes
on with it when called again; ``--table`` scores all that are there.

The capture is the bundled clip at a third of its size, there and back, of which everything from frame 5 on is another
scene: *recoloured* has its colour channels exchanged, *turned* shows renderings of a stream of the clip, turned by 70
degrees about the rig's axis under still cameras, with exchanged channels. The preset is a short ``fast``.
"""

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from benchmarks.machine import load_average, machine
from structgstream.cameras import Camera, normalizing_similarity
from structgstream.codec.reader import open_stream
from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.source import FrameSource, SourceWrapper, resized
from structgstream.evaluation.evaluate import evaluate
from structgstream.evaluation.run_log import read_log
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend, select_backend
from structgstream.recorder import record
from structgstream.scene.scene import Scene
from structgstream.session.loop import frame_seed, initial_points_of
from structgstream.session.periods import PeriodConfig
from structgstream.session.presets import FAST, StreamConfig
from structgstream.session.struct_gstream import stream_pipeline
from structgstream.training.frame0.fit import fit_first_frame
from structgstream.training.result import FitResult

FRAMES, CHANGE, KEY_EVERY = 12, 5, 4
DEGREES = 70.0
VARIANTS = {
    "none": PeriodConfig(),
    "scene": PeriodConfig(residual=1.5, frames=2, start="scene"),
    "scene-all": PeriodConfig(residual=1.5, frames=2, start="scene", share=1.0),
    "points": PeriodConfig(residual=1.5, frames=2),
    "seconds": PeriodConfig(seconds=8 / 30),
}
CASES = ("recoloured", "turned", "unchanged")


def config_of(variant: str) -> StreamConfig:
    """The preset ``fast`` with a third of frame 0's iterations, and key packets every few frames."""
    growth = replace(
        FAST.initial.growth,
        collect_from=26,
        start=50,
        stop=330,
        interval=35,
        room_until=240,
        eligible_count=7,
        prune_visits=13,
    )
    initial = replace(FAST.initial, iterations=400, schedule_iterations=400, coarse_iterations=280, growth=growth)
    return replace(FAST, initial=initial, key_interval_seconds=KEY_EVERY / 30, period=VARIANTS[variant])


def clip() -> FrameSource:
    """The bundled clip at a third of its size."""
    return resized(bundled_clip(), 1 / 3)


def clip_frame(index: int) -> int:
    """The clip's frame that is shown: there and back."""
    last = len(bundled_clip()) - 1
    return last - abs(index % (2 * last) - last)


def turned(camera: Camera, middle: torch.Tensor, axis: torch.Tensor) -> Camera:
    """The camera that sees a still scene as ``camera`` sees the scene turned about ``axis`` through ``middle``."""
    angle, (x, y, z) = math.radians(DEGREES), axis.tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.linalg.matrix_exp(angle * cross)
    turn[:3, 3] = middle - turn[:3, :3] @ middle
    return replace(camera, viewmat=camera.viewmat @ turn)


@dataclass(frozen=True)
class Changed(SourceWrapper):
    """The clip, there and back, which is another scene from frame :data:`CHANGE` on.

    Args:
        case: of :data:`CASES`.
        first: the stream of the clip that *turned* shows.
        backend: draws it.
    """

    case: str
    first: Path
    backend: Backend

    def __len__(self) -> int:
        return FRAMES

    @property
    def name(self) -> str:
        return self.case

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for index in range(start, FRAMES):
            yield MultiViewFrame(index, index / self.fps, self._pictures(index))

    def _pictures(self, index: int) -> dict[str, np.ndarray]:
        shown = clip_frame(index)
        if index >= CHANGE and self.case == "turned":
            images = _turned_pictures(self.first, shown, self.backend)
        else:
            images = dict(next(self.source.frames(shown)).images)
        if index < CHANGE or self.case == "unchanged":
            return images
        return {name: np.ascontiguousarray(image[..., [1, 2, 0]]) for name, image in images.items()}


@cache
def _turned_pictures(stream: Path, index: int, backend: Backend) -> dict[str, np.ndarray]:
    rig = clip().rig
    centers = torch.stack([rig[name].center.double() for name in rig])
    middle = centers.mean(0)
    axis = torch.linalg.svd(centers - middle).Vh[-1]
    with open_stream(stream) as reader:
        return {name: reader.render(index, turned(rig[name], middle, axis), backend=backend) for name in rig}


def first_fit(source: FrameSource, backend: Backend) -> FitResult[Scene]:
    """The fit of frame 0, which is the same in all cases, without its environment."""
    config, similarity = config_of("none"), normalizing_similarity(source.rig, radius=FAST.NORMALISED_RADIUS)
    frame = next(source.frames())
    points = initial_points_of(source, frame, config=config.points, seed=0, similarity=similarity)
    rig = similarity.rig(source.rig)
    seed = frame_seed(config.seed, 0)
    return fit_first_frame(frame, rig, points, config=config.initial, backend=backend, seed=seed)


def make(folder: Path, case: str, variant: str, backend: Backend) -> None:
    """Make the stream of a variant, or what is missing of it; all start from one fit of frame 0."""
    path, first = folder / f"{case}-{variant}.sgs", folder / "clip.sgs"
    fit = folder / "first.pt"

    def fitted() -> FitResult[Scene]:
        return torch.load(fit, weights_only=False)

    if case == "clip":
        source: FrameSource = clip()
        path = first
        if not fit.exists():
            torch.save(first_fit(source, backend), fit)
        pipeline = stream_pipeline(config_of("none"), fitted=fitted)
    else:
        source = Changed(clip(), case, first, backend)
        pipeline = stream_pipeline(config_of(variant), fitted=fitted)
    run = record(path, source, pipeline, backend, resume=path.exists(), metadata={"case": case})
    for report in run.reports:
        print(
            report.index,
            f"{report.train_psnr:.2f} dB",
            report.bytes,
            f"{report.cpu_seconds:.1f} s",
            report.begins or "",
            flush=True,
        )


def table(folder: Path, backend: Backend) -> list[dict[str, object]]:
    """The scores of all streams that are there."""
    rows = []
    for path in sorted(folder.glob("*-*.sgs")):
        case, variant = path.stem.split("-", 1)
        log = read_log(path)
        with open_stream(path) as reader:
            source = Changed(clip(), case, folder / "clip.sgs", backend)
            report = evaluate(reader, source, backend=backend, metrics="basic", log=log)
            psnr = [frame.mean.psnr if frame.mean else math.nan for frame in report.frames]
            infos, periods = [*reader.packets], reader.periods
            begun = periods[1].first_frame if len(periods) > 1 else None
            rows.append(
                {
                    "case": case,
                    "variant": variant,
                    "psnr": [round(value, 2) for value in psnr],
                    "bytes": [info.bytes for info in infos],
                    "headers": [period.bytes for period in periods],
                    "begins": begun,
                    "why": next((one["begins"] for one in log.values() if one.get("begins")), None),
                    "cpu_seconds": [round(log[index].get("cpu_seconds", 0.0), 1) for index in sorted(log)],
                }
            )
    return rows


def main() -> None:
    """Reads the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--case", choices=("clip", *CASES), default="clip", help="clip comes first")
    parser.add_argument("--variant", choices=VARIANTS, default="none")
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    backend = select_backend("auto")
    if options.table:
        found = {"machine": machine(), "load": load_average(), "streams": table(options.folder, backend)}
        (options.folder / "periods.json").write_text(json.dumps(found, indent=1))
        for row in found["streams"]:
            print(json.dumps(row))
    else:
        make(options.folder, options.case, options.variant, backend)


if __name__ == "__main__":
    main()
