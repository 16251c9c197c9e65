# SPDX-License-Identifier: Apache-2.0
"""The loop for peers: as this project's, with another method in its middle and another file at its end."""

import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, cast

import torch

from structgstream.beginning import frame_seed, initial_points_of
from structgstream.cameras import CameraRig
from structgstream.codec.container.records import PREFIX, record_at
from structgstream.codec.container.stored import StoredFile
from structgstream.codec.header import packed_header, unpacked_header
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.data.source import FrameSource
from structgstream.errors import ConfigError, StorageError
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.memory import PeakMeter
from structgstream.presets import RIG, to_json
from structgstream.scene.scene import Scene
from structgstream.scene.state import STATE_TABLE, FieldName
from structgstream.session import FrameReport
from structgstream.similarity import normalising_similarity
from structgstream.training.result import StepListener
from structgstream_studies.peers.container import PeerReader, PeerWriter, check_prefix
from structgstream_studies.peers.method import Memory, PeerMethod, State


class PeerSession(Generic[State, Memory]):
    """Runs a method over a capture into a file, frame by frame; the next frame starts from the decoded one.

    Initial points, normalisation and seeds are those that ``session.Session`` has with the preset ``rig``.

    Args:
        source: the capture.
        path: the file.
        method: what fits, codes and decodes.
        backend: what computes.
        seed: of the stream.
        resume: go on after the last whole frame of the file, if there is one.
        metadata: plain JSON values for the header; a file with others is not resumed.
        on_step: called after every optimisation step.

    Raises:
        ConfigError: the file to resume was made by another method or configuration, from another capture or seed.
        StorageError: the file exists and is not to be resumed.
    """

    def __init__(
        self,
        source: FrameSource,
        path: Path | str,
        method: PeerMethod[State, Memory],
        backend: Backend,
        *,
        seed: int = 0,
        resume: bool = False,
        metadata: Mapping[str, object] | None = None,
        on_step: StepListener | None = None,
    ) -> None:
        self._source, self._path, self._method, self._backend = source, Path(path), method, backend
        self._seed, self._on_step = seed, on_step
        self._similarity = normalising_similarity(source.rig, radius=RIG.normalised_radius)
        self._rig = self._similarity.rig(source.rig)
        self._header = StreamHeader(
            rig=source.rig,
            similarity=self._similarity,
            fps=source.fps,
            codec=method.name,
            dynamic=frozenset(field.name for field in STATE_TABLE),
            static={},
            distance_input=False,
            config=to_json(method.config),
            metadata={"capture": source.name, "seed": seed, **(metadata or {})},
        )
        self._resumed = self._existing(resume)

    @property
    def done(self) -> int:
        """How many frames the file held when the session was made."""
        return 0 if self._resumed is None else len(self._resumed)

    def run(self) -> Generator[FrameReport, None, None]:
        """Fit and write every frame that the file does not hold yet; yields a report for each.

        The file is closed however the loop ends, and marked as complete when no frame is missing.
        """
        resumed = self._resumed
        if resumed is not None and len(resumed) >= len(self._source):
            if resumed.complete:
                return
            PeerWriter(self._path, self._header, resumed=resumed).close(complete=True)
            return
        writer = PeerWriter(self._path, self._header, resumed=resumed)
        try:
            yield from self._frames(writer, resumed)
        except BaseException:
            with suppress(StorageError):  # What went wrong first is what the user must see.
                writer.close(complete=False)
            raise
        writer.close(complete=True)

    def _frames(self, writer: PeerWriter, resumed: PeerReader[State] | None) -> Iterator[FrameReport]:
        method, device = self._method, self._backend.device
        state, memory, start = self._continued(resumed)
        frames = self._source.frames(start)
        while True:
            peaks = PeakMeter(device)
            started, cpu_started = time.perf_counter(), time.process_time()
            frame = next(frames, None)
            if frame is None:
                return
            peaks.end("read")
            read = time.perf_counter()
            options: dict[str, Any] = {
                "backend": self._backend,
                "seed": frame_seed(self._seed, frame.index),
                "on_step": self._on_step,
            }
            points = self._points(frame)
            if state is None:
                fit = method.first(frame, self._rig, points, **options)
            else:
                fit = method.next(state, cast(Memory, memory), frame, self._rig, points, **options)
            peaks.end("fit")
            fitted = time.perf_counter()
            arrays = method.arrays(fit.state)
            alone = state is None or method.stands_alone
            state = method.restored(arrays, None if alone else state, device=device)
            kind = PacketKind.KEY if alone else PacketKind.DELTA
            coded = time.perf_counter()
            size, field_bytes = writer.write(kind, frame.index, frame.pts_seconds, arrays)
            peaks.end("store")
            written = time.perf_counter()
            if frame.index == 0:
                memory = method.prepared(state, backend=self._backend, seed=frame_seed(self._seed, 0))
                peaks.end("prepare")
            done = time.perf_counter()
            anchors = len(state.anchors) if isinstance(state, Scene) else 0
            yield FrameReport(
                index=frame.index,
                pts_seconds=frame.pts_seconds,
                kind=kind,
                bytes=size,
                # Other methods have other fields; a report only passes their names on.
                field_bytes=cast("Mapping[FieldName, int]", field_bytes),
                train_psnr=fit.train_psnr,
                anchors=anchors,
                moving=0,
                free=0 if isinstance(state, Scene) else len(cast(Any, state)),
                spawned=fit.spawned,
                pruned=fit.pruned,
                seconds={
                    "read": read - started,
                    **fit.seconds,
                    "fit": fitted - read,
                    "encode": coded - fitted,
                    "write": written - coded,
                    "prepare": done - written,
                    "total": done - started,
                },
                peak_memory_bytes=peaks.process_bytes,
                peak_device_bytes=peaks.device_bytes,
                peak_memory_kind=peaks.kind,
                cpu_seconds=time.process_time() - cpu_started,
            )

    def _points(self, frame: MultiViewFrame):
        def made() -> torch.Tensor:
            return initial_points_of(
                self._source, frame, config=RIG.points, seed=self._seed, similarity=self._similarity
            )

        return made

    def _continued(self, resumed: PeerReader[State] | None) -> tuple[State | None, Memory | None, int]:
        """The last decoded state of the file, what the method remembers, and the next frame's number."""
        state: State | None = None
        memory: Memory | None = None
        if resumed is None or not len(resumed):
            return None, None, 0
        for info in resumed.packets:
            alone = info.kind is PacketKind.KEY
            previous = None if alone else state
            state = self._method.restored(resumed.arrays(info.index), previous, device=self._backend.device)
            if info.index == 0:
                memory = self._method.prepared(state, backend=self._backend, seed=frame_seed(self._seed, 0))
        return state, memory, len(resumed)

    def _existing(self, resume: bool) -> PeerReader[State] | None:
        """The reader of a file to go on with; None when there is nothing whole in it."""
        if not self._path.exists():
            return None
        if not resume:
            raise StorageError(f"{self._path} exists; resume it, or choose another name.")
        data = StoredFile(self._path)
        if len(data) < PREFIX.size:
            return None
        check_prefix(data, str(self._path))
        if record_at(data, PREFIX.size) is None:
            return None
        reader = PeerReader(data, lambda _: self._method, name=str(self._path))
        self._check_resumable(reader.header)
        return reader

    def _check_resumable(self, header: StreamHeader) -> None:
        ours = unpacked_header(packed_header(self._header))
        pairs = {
            "method": (header.codec, ours.codec),
            "configuration": (header.config, ours.config),
            "capture, part of it or seed": (header.metadata, ours.metadata),
            "frame rate": (header.fps, ours.fps),
            "cameras": (_facts(header.rig), _facts(ours.rig)),
        }
        differing = [name for name, (theirs, mine) in pairs.items() if theirs != mine]
        if differing:
            raise ConfigError(
                f"{self._path} was made with another {', '.join(differing)}; resume it with the same, "
                "or choose another name."
            )


def _facts(rig: CameraRig) -> list[object]:
    """The rig as plain values."""
    return [
        (name, name in rig.held_out, camera.viewmat.tolist(), camera.K.tolist(), camera.width, camera.height)
        for name, camera in rig.cameras.items()
    ]
