# SPDX-License-Identifier: Apache-2.0
"""A stream on the disk and the log beside it: begun, gone on with, and written frame by frame."""

import os
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from structgstream.codec.sinks import FileSink
from structgstream.data.prefetch import Prefetch
from structgstream.data.source import FrameSource
from structgstream.errors import StorageError
from structgstream.evaluation.run_log import append_log, begin_log, log_entry
from structgstream.kernels.backend import Backend
from structgstream.presets import StreamConfig
from structgstream.session import FrameReport, Session
from structgstream.training.result import FitResult, StepListener

Remarks = Callable[[FrameReport], Mapping[str, Any]]
"""What a frame's line of the log holds beside its report."""


class Recorder:
    """A stream file and its log, which :meth:`record` writes.

    Nothing is written before :meth:`record` is called.

    Args:
        path: the stream; what is there is replaced unless it is resumed.
        resume: go on after the last whole frame of what is there.

    Attributes:
        done: how many frames are there already.

    Raises:
        StreamError: what is to be resumed is no stream, or damaged where nothing can be saved.
    """

    def __init__(self, path: Path, *, resume: bool = False) -> None:
        self._path = path
        self._sink, self._resumed = FileSink.resume(path) if resume else (FileSink(path, overwrite=True), None)
        self.done = 0 if self._resumed is None else len(self._resumed)

    def record(
        self,
        source: FrameSource,
        config: StreamConfig,
        backend: Backend,
        *,
        metadata: Mapping[str, object] | None = None,
        first: FitResult | None = None,
        on_step: StepListener | None = None,
        remarks: Remarks | None = None,
    ) -> Generator[FrameReport, None, None]:
        """Reconstructs every frame that is not there yet, stores it, notes it in the log, and reports it.

        The configuration is checked and the log begun in the call; frames come as the generator is advanced.

        Args:
            source: the capture; its frames are read ahead.
            config: everything that decides the result.
            backend: what computes.
            metadata: plain JSON values for the header, the same in every run that is to be resumed.
            first: frame 0 as it was fitted before.
            on_step: called after every optimisation step.
            remarks: see :data:`Remarks`.

        Raises:
            ConfigError: the stream to resume was made with another configuration or from another capture.
            StorageError: stream or log cannot be written; whole frames are in the file.
        """
        session = Session(
            Prefetch(source),
            self._sink,
            config,
            backend,
            resumed=self._resumed,
            metadata=metadata,
            first=first,
            on_step=on_step,
        )
        return logged(session.run(), self._path, done=self.done, remarks=remarks)


def logged(
    reports: Generator[FrameReport, None, None], path: Path, *, done: int, remarks: Remarks | None = None
) -> Generator[FrameReport, None, None]:
    """The reports of a run, each noted in the log beside ``path`` before it is passed on.

    Args:
        reports: of a session of this method or of another; closed with the result.
        path: the file that the session writes.
        done: how many frames it holds already, whose lines of the log stay.
        remarks: see :data:`Remarks`.

    Raises:
        StorageError: the log cannot be written.
    """
    begin_log(path, frames=done)
    return _noted(reports, path, remarks)


def _noted(
    reports: Generator[FrameReport, None, None], path: Path, remarks: Remarks | None
) -> Generator[FrameReport, None, None]:
    with closing(reports):
        for report in reports:
            further = {} if remarks is None else remarks(report)
            append_log(path, log_entry(report) | dict(further))
            yield report


def check_output(path: Path, *, may_exist: bool) -> None:
    """Whether the stream can be written is found out before the first frame takes its minutes.

    Raises:
        StorageError: the file exists, its folder cannot be made, or nothing may be written there.
    """
    if path.is_dir():
        raise StorageError(f"{path} is a folder; give the name of a file, such as {path / 'scene.sgs'}.")
    if path.exists() and not may_exist:
        raise StorageError(
            f"{path} exists; continue it with --resume, replace it with --overwrite, or choose another name."
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"The folder {path.parent} cannot be made ({error.strerror}).") from None
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise StorageError(f"{path} cannot be written (no permission).")
