# SPDX-License-Identifier: Apache-2.0
"""Peers as tasks of an experiment, beside the variants of our own method."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from structgstream.session.presets import to_json
from structgstream_studies.experiments.captures import CapturePart
from structgstream_studies.experiments.results import write_result
from structgstream_studies.experiments.tasks import is_result_of, score_recording

if TYPE_CHECKING:
    from structgstream.evaluation.recording import Recording
    from structgstream.kernels.backend import Backend
    from structgstream.session.frame_report import FrameReport

PEER_TITLES: Mapping[str, str] = {
    "3dgstream": "3DGStream's method",
    "scaffold-gs": "Scaffold-GS, every frame from scratch",
    "3dgs": "3DGS, every frame from scratch",
}


@dataclass(frozen=True)
class PeerRun:
    """Reconstructs and scores a capture with another method (``structgstream_studies.peers``)."""

    key: str
    capture: CapturePart
    seed: int
    folder: Path
    frames: int

    @property
    def name(self) -> str:
        """Its name in logs and files."""
        return f"{self.key}.seed{self.seed}"

    @property
    def needs(self) -> tuple[str, ...]:
        """It depends on no other task."""
        return ()

    @property
    def stream(self) -> Path:
        """The method's own file."""
        return self.folder / "streams" / f"{self.name}.sgp"

    @property
    def result(self) -> Path:
        """Its scores."""
        return self.folder / "results" / f"{self.name}.json"

    def done(self) -> bool:
        """Whether there is a result with the same identity."""
        return is_result_of(self.result, self._identity(), self.capture, frames=self.frames)

    def _identity(self) -> dict[str, Any]:
        from structgstream_studies.peers.methods import METHODS

        return {"key": self.key, "method": self.key, "seed": self.seed, "config": to_json(METHODS[self.key].config)}

    def recording(self) -> "Recording":
        """The file, opened."""
        from structgstream_studies.peers.methods import open_peer

        return open_peer(self.stream)

    def run(self, backend: "Backend") -> None:
        """Reconstructs the missing frames of the file, then scores it."""
        self._reconstruct(backend)
        write_result(
            self.result,
            score_recording(self.recording(), self.stream, self.capture, backend, run_identity=self._identity()),
        )

    def _reconstruct(self, backend: "Backend") -> None:
        from structgstream.evaluation.environment import environment
        from structgstream.recorder import record
        from structgstream_studies.peers.codec import peer_pipeline
        from structgstream_studies.peers.methods import METHODS

        self.stream.parent.mkdir(parents=True, exist_ok=True)
        pipeline = peer_pipeline(METHODS[self.key], seed=self.seed)
        step = self.capture.every * self.capture.thinned
        part = {"start": self.capture.start, "scale": self.capture.scale, "every": step}
        machine = environment() | {"backend": backend.name}

        def remarks(report: "FrameReport") -> Mapping[str, Any]:
            return {} if report.index else {"trained_by": machine}

        run = record(self.stream, self.capture.open(), pipeline, backend, resume=True, metadata=part, remarks=remarks)
        for _ in run.reports:
            pass
