# SPDX-License-Identifier: Apache-2.0
"""The log of a reconstruction: seconds and memory by stage, PSNR on training views.

``OUT.log.jsonl`` next to ``OUT.sgs`` has one JSON object per line, written after each frame, so that a crash loses none
and a resumed run appends. ``stream`` is the stream's name: ``OUT`` and ``OUT.sgs`` would share a log, so the second is
refused. ``peak_memory_bytes`` is the frame's largest peak; ``peak_memory_kind`` states whether peaks are of each stage
(``stage``) or of the process since its start (``process``).
"""

import json
import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from structgstream.atomic_files import atomic_write, side_path
from structgstream.errors import StorageError

if TYPE_CHECKING:
    from structgstream.session.frame_report import FrameReport

_log = logging.getLogger(__name__)


def log_path(stream: Path) -> Path:
    """The path of a stream's log."""
    return side_path(stream, ".log.jsonl")


def begin_log(stream: Path, *, frames: int = 0) -> None:
    """Removes the entries from frame ``frames`` on: all for a new run, those of frames that were not stored for a
    resumed one. Raises StorageError if the file cannot be written, or it, or the metrics, are of another stream."""
    check_side_files(stream)
    entries = [entry for index, entry in sorted(read_log(stream).items()) if index < frames]
    atomic_write(log_path(stream), _lines(entries), called="The log")


def check_side_files(stream: Path) -> None:
    """Check that the log and the metrics next to a stream do not belong to another stream. Raises StorageError if they
    do; nothing was changed."""
    metrics = side_path(stream, ".metrics.json")
    for path, entries in ((log_path(stream), read_log(stream).values()), (metrics, _metrics_in(metrics))):
        for name in {str(entry.get("stream", stream.name)) for entry in entries} - {stream.name}:
            if side_path(Path(name), "") != side_path(Path(stream.name), ""):
                continue  # The stream was renamed together with its files.
            raise StorageError(
                f"{path} belongs to the stream {name}, and {stream.name} would need a file of the same name; choose "
                "another name for this stream, or move that file to another place."
            )


def append_log(stream: Path, entry: Mapping[str, Any]) -> None:
    """Adds a frame; ``entry`` has an ``index`` and plain values. Raises StorageError if the file cannot be written."""
    path = log_path(stream)
    try:
        with path.open("ab") as file:
            file.write(_lines([{**entry, "stream": stream.name}]))
    except OSError as error:
        raise StorageError(f"The log {path} cannot be written ({error.strerror}).") from None


def log_entry(report: "FrameReport") -> dict[str, Any]:
    """One line of the log: the frame's report as plain values, and seconds and memory of the whole frame."""
    # Not in the log where they are usual; the peaks of a device have another name below.
    usual = {"absent": (), "begins": None, "mean_of": 1, "peak_device_bytes": report.peak_device_bytes}
    entry = {name: value for name, value in asdict(report).items() if name not in usual or value != usual[name]}
    return entry | {
        "kind": report.kind.name.lower(),
        "train_psnr": report.train_psnr if math.isfinite(report.train_psnr) else None,
        "total_seconds": report.seconds["total"],
        "peak_memory_bytes": max(report.peak_memory_bytes.values(), default=None),
        "peak_memory_bytes_by_stage": dict(report.peak_memory_bytes),
        "peak_device_bytes_by_stage": dict(report.peak_device_bytes),
        "peak_memory_kind": str(report.peak_memory_kind),
    }


def read_log(stream: Path) -> dict[int, dict[str, Any]]:
    """Entries by frame number; the later of two entries for a frame; lines truncated by a crash are skipped."""
    entries = {}
    for entry in json_lines(log_path(stream)):
        with suppress(ValueError, KeyError, TypeError, OverflowError):
            entries[int(entry["index"])] = entry
    return entries


def json_lines(path: Path) -> Iterator[Any]:
    """The values in the lines of a file, without those that are no JSON; none if the file cannot be read."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError):
        return
    for line in lines:
        with suppress(ValueError, RecursionError):
            yield json.loads(line)


def log_of(stream: Path, sizes: Mapping[int, int]) -> dict[int, dict[str, Any]]:
    """The log next to a stream with packets of these bytes, by frame number; empty, with a warning, if it is of another
    run, such as of a stream that was there before this one was joined or copied to its place."""
    entries = read_log(stream)
    if any(entry.get("bytes") != sizes[index] for index, entry in entries.items() if index in sizes):
        _log.warning(
            "%s is not used: its frames have other sizes than those of %s, so it is of another run",
            log_path(stream),
            stream,
        )
        return {}
    return entries


def _metrics_in(path: Path) -> list[dict[str, Any]]:
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return []
    return [found] if isinstance(found, dict) else []


def _lines(entries: Iterable[Mapping[str, Any]]) -> bytes:
    return "".join(f"{json.dumps(entry)}\n" for entry in entries).encode()
