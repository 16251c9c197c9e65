# SPDX-License-Identifier: Apache-2.0
"""The steps of an experiment as values that another process can run and resume."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from structgstream.errors import ConfigError
from structgstream.session.presets import StreamConfig, to_json
from structgstream.session.rate_control import RateConfig
from structgstream.training.frame0.seeding import EnvironmentConfig
from structgstream.training.online.config import OnlineConfig
from structgstream_studies.errors import ExperimentError
from structgstream_studies.experiments.captures import CapturePart, capture_facts
from structgstream_studies.experiments.results import Result, read_result, result_of, round_floats, write_result

if TYPE_CHECKING:
    from structgstream.evaluation.recording import Recording
    from structgstream.kernels.backend import Backend
    from structgstream.scene.scene import Scene
    from structgstream.session.frame_report import FrameReport
    from structgstream.training.result import FitResult


@dataclass(frozen=True)
class FirstFrameRun:
    """Fits frame 0 once for all the variants that begin with it."""

    capture: CapturePart
    config: StreamConfig
    folder: Path

    @property
    def name(self) -> str:
        """Its name in logs, equal for tasks with the same frame 0."""
        decides = {key: value for key, value in to_json(self._alone).items() if key != "online"}
        text = json.dumps(
            [decides, {**vars(self.capture), "folder": str(self.capture.folder), "frames": None, "scored": None}]
        )
        return f"first-{hashlib.sha256(text.encode()).hexdigest()[:8]}.seed{self.config.seed}"

    @property
    def needs(self) -> tuple[str, ...]:
        """Nothing comes before it."""
        return ()

    @property
    def frames(self) -> int:
        """Number of frames that it fits."""
        return 1

    @property
    def stream(self) -> Path:
        """The stream of one frame."""
        return self.folder / "first" / f"{self.name}.sgs"

    @property
    def _alone(self) -> StreamConfig:
        """The configuration that determines it, stored unquantized, because streams quantize it differently."""
        # What is behind the scene is found when a stream begins.
        plain = replace(self.config, online=OnlineConfig(), codec="raw", rate=RateConfig())
        return replace(plain, environment=EnvironmentConfig())

    def done(self) -> bool:
        """Whether the frame is stored; an interrupted stream has none."""
        from structgstream.codec.reader import open_stream
        from structgstream.errors import StreamError

        if not self.stream.exists():
            return False
        try:
            return len(open_stream(self.stream)) == 1
        except StreamError:
            return False

    def run(self, backend: "Backend") -> None:
        """Fits and stores it."""
        if self.done():
            return
        _reconstruct(replace(self.capture, frames=1), self._alone, self.stream, backend, first=None)

    def fitted(self) -> "FitResult[Scene]":
        """The frame as ``StructGStream`` takes it, read from the file."""
        from structgstream.codec.reader import open_stream
        from structgstream.training.result import FitResult

        return FitResult(
            scene=open_stream(self.stream).scene(0),
            iterations=self.config.initial.iterations,
            train_psnr=float(self.log()["train_psnr"]),
        )

    def log(self) -> dict[str, Any]:
        """The frame's entry in the log."""
        from structgstream.evaluation.run_log import read_log

        return read_log(self.stream)[0]


@dataclass(frozen=True)
class VariantRun:
    """Reconstructs and scores one variant of the method with one seed."""

    key: str
    capture: CapturePart
    config: StreamConfig
    folder: Path
    frames: int

    @property
    def name(self) -> str:
        """Its name in logs and files."""
        return f"{self.key}.seed{self.config.seed}"

    @property
    def seed(self) -> int:
        """The random seed."""
        return self.config.seed

    @property
    def first(self) -> FirstFrameRun:
        """Its frame 0, which other variants may share."""
        return FirstFrameRun(self.capture, self.config, self.folder)

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the tasks that it needs: frame 0, unless the stream has it already."""
        return () if self._has_started() else (self.first.name,)

    @property
    def stream(self) -> Path:
        """The stream."""
        return self.folder / "streams" / f"{self.name}.sgs"

    @property
    def result(self) -> Path:
        """Its scores."""
        return self.folder / "results" / f"{self.name}.json"

    def done(self) -> bool:
        """Whether there is a result with the same identity."""
        return is_result_of(self.result, self._identity(), self.capture, frames=self.frames)

    def _has_started(self) -> bool:
        from structgstream.evaluation.run_log import read_log

        return self.stream.exists() and 0 in read_log(self.stream)

    def _identity(self) -> dict[str, Any]:
        return {"key": self.key, "method": "struct-gstream", "seed": self.config.seed, "config": to_json(self.config)}

    def run(self, backend: "Backend") -> None:
        """Reconstructs the missing frames of the stream, then scores the file."""
        _reconstruct(self.capture, self.config, self.stream, backend, first=self.first)
        write_result(
            self.result,
            score_recording(self.recording(), self.stream, self.capture, backend, run_identity=self._identity()),
        )

    def recording(self) -> "Recording":
        """The stream, opened."""
        from structgstream.codec.reader import open_stream

        return open_stream(self.stream)


def is_result_of(result: Path, run_identity: Mapping[str, Any], capture: CapturePart, *, frames: int) -> bool:
    """Whether a result is there and is the answer to this very question, on these ``frames`` of the capture."""
    found = read_result(result)
    if found is None:
        return False
    identity = dict(found.identity)
    of = identity.pop("capture")
    part = (of["start"], of["scale"], of["every"], of.get("near"), of["frames"])
    same_part = part == (capture.start, round_floats(capture.scale), capture.every, round_floats(capture.near), frames)
    same_part = same_part and of.get("thinned", 1) == capture.thinned
    same_split = capture.held_out is None or set(of["held_out"]) == set(capture.held_out)
    same_cameras = set(of["scored"]) == set(capture.scored or of["held_out"])
    return identity == round_floats(run_identity) and same_part and same_split and same_cameras


def score_recording(
    recording: "Recording", stream: Path, capture: CapturePart, backend: "Backend", *, run_identity: Mapping[str, Any]
) -> Result:
    """The scores of a finished file, with what was asked and who trained it."""
    from structgstream.evaluation.evaluate import evaluate
    from structgstream.evaluation.run_log import read_log

    source, log = capture.open(), read_log(stream)
    report = evaluate(recording, source, backend=backend, cameras=capture.scored, log=log)
    identity = {**run_identity, "capture": capture_facts(capture, source)}
    return result_of(report, identity=identity, trained_by=log.get(0, {}).get("trained_by", {}))


def _reconstruct(
    capture: CapturePart, config: StreamConfig, stream: Path, backend: "Backend", *, first: FirstFrameRun | None
) -> None:
    """Reconstructs into ``stream``, going on after the frames that it holds."""
    from structgstream.evaluation.environment import environment
    from structgstream.evaluation.recording import part_metadata
    from structgstream.recorder import record
    from structgstream.session.struct_gstream import stream_pipeline

    source = capture.open()
    stream.parent.mkdir(parents=True, exist_ok=True)
    machine = environment() | {"backend": backend.name}

    def remarks(report: "FrameReport") -> Mapping[str, Any]:
        # A shared frame 0 keeps the seconds and memory of its own fit.
        shared = first.log() if first is not None and report.index == 0 else {}
        return {**shared, "trained_by": machine} if report.index == 0 else {}

    pipeline = stream_pipeline(config, fitted=None if first is None else first.fitted)
    metadata = part_metadata(start=capture.start, scale=capture.scale, every=capture.thinned)
    try:
        run = record(stream, source, pipeline, backend, resume=True, metadata=metadata, remarks=remarks)
    except ConfigError as error:
        raise ExperimentError(f"{stream} answers another question, so choose another folder. {error}") from None
    if run.done > len(source):
        raise ExperimentError(
            f"{stream} has {run.done} frames already and {len(source)} are asked for; choose another folder for fewer."
        )
    if run.done < len(source):
        for _ in run.reports:
            pass
