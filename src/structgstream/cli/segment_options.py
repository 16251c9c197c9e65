# SPDX-License-Identifier: Apache-2.0
"""Options of a stream that is written as segments, and where it goes."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from structgstream.cli.app import UsageError

if TYPE_CHECKING:
    from structgstream.codec.segments.sink import SegmentsOptions
    from structgstream.codec.segments.store import Store
    from structgstream.recorder import Storage
    from structgstream.scene.scene import Scene

    Captured = Callable[[int], float | None]
    SegmentsStorage = Callable[[Captured | None], Storage[Scene]]
    """Given when frames were filmed, by their number, in seconds since 1970; None where that is not known."""

FINISH_SECONDS = 60.0
"""How long the end of a run waits for what is still to be published."""
Sink = Literal["file", "segments"]


@dataclass(frozen=True)
class SegmentOptions:
    """Options of --sink segments (docs/segments.md)."""

    sink: Annotated[Sink | None, tyro.conf.arg(help_behavior_hint="")] = None
    """file: OUT is one file. segments: OUT is a folder of immutable files and a manifest, which any web host can serve
    while it grows. Default: segments if OUT is a folder with a manifest.json, else file."""
    window: Annotated[float | None, tyro.conf.arg(metavar="SECONDS", help_behavior_hint="")] = None
    """Segments only: how far viewers can go back; older segments are removed. Default: nothing is removed."""
    keep: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 120.0
    """Segments only: how long a file stays that the manifest no longer names; viewers may be about to fetch it."""
    publish: Annotated[str | None, tyro.conf.arg(metavar="URL", help_behavior_hint="")] = None
    """Segments only: copy OUT to this folder of an object store as it grows, such as s3://bucket/studio. When it cannot
    be reached, the stream continues in OUT, and is copied later. Needs the extra cloud."""

    def chosen(self, output: Path) -> Sink:
        """The sink of ``output``.

        Raises:
            UsageError: options of segments for a file, or values that make no sense.
        """
        from structgstream.codec.segments.manifest import MANIFEST
        from structgstream.codec.segments.quality_list import read_list

        if read_list(output) is not None:
            raise UsageError(
                f"{output} holds several qualities of one stream; continue them with --qualities, or choose another "
                "name."
            )
        found: Sink = "segments" if (output / MANIFEST).is_file() else "file"
        sink = self.sink or found
        if sink == "file" and (self.window is not None or self.publish is not None):
            raise UsageError(f"{'--publish' if self.window is None else '--window'} is for --sink segments.")
        self._check_seconds()
        return sink

    def _check_seconds(self) -> None:
        if not (self.window is None or 0 < self.window < math.inf) or not self.keep >= 0:
            raise UsageError("--window must be a positive number of seconds, and --keep zero or more.")

    def quality_folders(
        self, output: Path, names: Sequence[str], *, resume: bool, overwrite: bool
    ) -> "dict[str, SegmentsStorage]":
        """Where each quality of a stream goes, a folder in ``output``, checked before anything takes time.

        Raises:
            UsageError: options that make no sense for several qualities, or ``output`` holds something else.
            StorageError: a folder exists and may not be replaced, or cannot be written.
        """
        from structgstream.codec.segments.manifest import MANIFEST
        from structgstream.codec.segments.quality_list import read_list
        from structgstream.codec.segments.sink import SegmentsOptions
        from structgstream.recorder import segments_folder

        listed = read_list(output)
        if self.sink == "file" or (self.sink is None and listed is None):
            got = "no --sink" if self.sink is None else "--sink file"
            raise UsageError(
                f"--qualities writes a folder of segments for each quality, got {got}; add --sink segments."
            )
        if self.publish is not None:
            raise UsageError(
                "--publish copies one stream, and --qualities writes several; copy the folder with another program, or "
                "run without it."
            )
        self._check_seconds()
        if (output / MANIFEST).is_file():
            raise UsageError(f"{output} holds one stream, and --qualities writes several; choose another name.")
        there = [] if listed is None else [quality.name for quality in listed]
        if listed is not None and (resume or overwrite) and sorted(there) != sorted(names):
            raise UsageError(
                f"{output} holds the qualities {', '.join(there)}, got {', '.join(names)}; give the same names, or "
                "choose another OUT."
            )
        stores = {name: segments_folder(output / name, may_exist=resume or overwrite) for name in names}
        options = SegmentsOptions(self.window, self.keep)
        return {name: partial(_storage, store, options) for name, store in stores.items()}

    @contextmanager
    def storage(
        self, output: Path, *, may_exist: bool, report: Callable[[str], object]
    ) -> Iterator["SegmentsStorage | None"]:
        """Where the stream goes, checked before anything takes time; None for the file ``output``.

        The end of the block waits until everything is published; ``report`` gets a sentence if that fails.

        Raises:
            StorageError: it exists and may not be replaced, or cannot be written, or what is to be published would
                replace another stream.
            MissingExtraError: a package is missing that the URL needs.
        """
        from structgstream.codec.segments.sink import SegmentsOptions
        from structgstream.recorder import check_output, segments_folder

        options = SegmentsOptions(self.window, self.keep)
        if self.chosen(output) == "file":
            check_output(output, may_exist=may_exist)
            yield None
        elif self.publish is None:
            yield partial(_storage, segments_folder(output, may_exist=may_exist), options)
        else:
            from structgstream.codec.segments.mirror import AnotherStreamError, MirroredStore, MirrorOptions
            from structgstream.codec.segments.store import CloudStore
            from structgstream.errors import StorageError, StreamError

            remote = CloudStore(self.publish)
            folder = segments_folder(output, may_exist=may_exist)
            mirror = MirroredStore(folder, remote, options=MirrorOptions(self.keep, report))
            try:
                mirror.claim()
            except AnotherStreamError:
                raise
            except (StorageError, StreamError):
                pass  # It cannot be reached now; it is claimed as soon as it can be.
            mirror.copy_all()  # What an earlier run has left, also if there is nothing to do now.
            try:
                yield partial(_storage, mirror, options)
            finally:
                if left := mirror.finish(wait_seconds=FINISH_SECONDS):
                    report(
                        f"{left} files of {output} are not yet in {remote.name}; the next run with --resume, or any "
                        "program that copies folders, copies them."
                    )


def _storage(store: "Store", options: "SegmentsOptions", captured: "Captured | None") -> "Storage[Scene]":
    from structgstream.codec.segments.sink import Clocks
    from structgstream.recorder import segments_at

    clocks = Clocks() if captured is None else Clocks(captured=captured)
    return segments_at(store, options=options, clocks=clocks)
