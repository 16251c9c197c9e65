# SPDX-License-Identifier: Apache-2.0
"""Which cameras have a picture of which frame, and a frame in which all have one."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from structgstream.data.images import ImageSource
from structgstream.data.source import FrameSource, unwrapped
from structgstream.data.video import VideoSource
from structgstream.frames import MultiViewFrame
from structgstream.geometry import Indices
from structgstream.pose_check.check import Finding

Presence = dict[str, NDArray[np.bool_]]
MAX_TRIED = 4  # frames, where pictures that should be there cannot be decoded
MAX_SINGLE = 2  # cameras that drop frames and get a sentence each
LOST_SECONDS, LOST_SHARE, MAX_LOST_SHARE = 0.5, 0.05, 0.25  # at the end, of the take


def stated_presence(source: FrameSource) -> Presence:
    """For each camera whether it has a picture of each frame ``[N]``, as far as files state it without being
    decoded."""
    inner = unwrapped(source)
    pictures: Mapping[str, tuple[object, ...]] = {}
    if isinstance(inner, VideoSource):
        pictures = inner.stamps
    elif isinstance(inner, ImageSource):
        pictures = inner.files
    return {
        name: np.array([picture is not None for picture in pictures[name][: len(source)]])
        if name in pictures
        else np.ones(len(source), bool)
        for name in source.rig
    }


def passed_frames(source: FrameSource) -> dict[str, Indices]:
    """By camera of videos, the frames that it lacks although it dropped no picture.

    A clock that runs slow makes pictures later and later against the frames, so that now and then none is nearest to a
    frame: the pictures before and after it follow each other in the file at the usual interval.
    """
    inner = unwrapped(source)
    if not isinstance(inner, VideoSource):
        return {}
    found = {name: _passed(own[: len(source)], inner.tracks[name].stamps) for name, own in inner.stamps.items()}
    return {name: frames for name, frames in found.items() if len(frames)}


def whole_frame(source: FrameSource, presence: Presence) -> MultiViewFrame:
    """The first frame of which all cameras have a picture.

    Where there is none it is one of those with most pictures, and the others come from other frames: cameras stand
    still. What turns out not to be decodable is noted in ``presence``.
    """
    counts = np.sum(list(presence.values()), axis=0)
    fullest = np.flatnonzero(counts == counts.max())
    best: MultiViewFrame | None = None
    for place in np.unique(np.linspace(0, len(fullest) - 1, MAX_TRIED).round().astype(int)):
        frame = _read(source, int(fullest[place]), presence)
        best = frame if best is None or len(frame.images) > len(best.images) else best
        if len(best.images) == counts.max():
            break
    assert best is not None, "captures have frames"
    for name in presence:
        if name not in best.images and presence[name].any():
            other = _read(source, int(np.flatnonzero(presence[name])[0]), presence)
            best = replace(best, images={**other.images, **best.images}, masks={**other.masks, **best.masks})
    return best


def note(frame: MultiViewFrame, presence: Presence) -> None:
    """Notes in ``presence`` which cameras a frame that was read has."""
    for name, present in presence.items():
        present[frame.index] = name in frame.images


def presence_findings(presence: Presence, fps: float, *, passed: Mapping[str, Indices] | None = None) -> list[Finding]:
    """A warning for each camera that ends early or has nothing, and for those that drop frames or lack frame 0.

    Where many drop frames, as phones do, one warning has them all. Cameras are never stopped in the same instant: those
    that end within :func:`_slack` of the last one are in one note, which states what all have. Another one has
    those whose clocks run slow, by what they lack without having dropped it (``passed``, of :func:`passed_frames`).
    """
    passed, findings = passed or {}, []
    ends = {name: int(np.flatnonzero(own)[-1]) + 1 for name, own in presence.items() if own.any()}
    slack = _slack(max(map(len, presence.values()), default=0), fps)
    if early := {name: end for name, end in ends.items() if 0 < len(presence[name]) - end <= slack}:
        names, first = list(early), min(early.values())
        shown = ", ".join(map(repr, names[:8])) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
        sentence = (
            f"{shown} {'end' if len(names) > 1 else 'ends'} up to {(max(ends.values()) - first) / fps:.2f} s before "
            "the last camera, as cameras do that are stopped by hand; all of these have pictures up to frame "
            f"{first - 1} ({(first - 1) / fps:.2f} s)."
        )
        findings.append(Finding("note", sentence, tuple(names)))
    presence = {name: own[: early.get(name, len(own))] for name, own in presence.items()}
    if passed:
        shown = ", ".join(
            f"{name!r} {len(frames)}, the first at {frames[0] / fps:.2f} s" for name, frames in passed.items()
        )
        sentence = (
            f"Frames without a picture of cameras that dropped none: {shown}. Their clocks run slower than those of "
            "the others, so that their pictures pass from one frame to the next."
        )
        findings.append(Finding("note", sentence, tuple(passed)))
    lacking = {name: np.flatnonzero(~own[: ends.get(name, 0)]) for name, own in presence.items()}
    lacking = {name: np.setdiff1d(gaps, passed.get(name, [])) for name, gaps in lacking.items()}
    dropping = {name: gaps for name, gaps in lacking.items() if len(gaps)}
    for name, present in presence.items():
        end, total = ends.get(name, 0), len(present)
        sentences = []
        if not end:
            sentences.append(
                f"Camera {name!r} has no picture of any frame that can be read; leave it out, or restore its files."
            )
        if name in dropping and len(dropping) <= MAX_SINGLE:
            first = dropping[name][0]
            sentences.append(
                f"Camera {name!r} lacks {len(dropping[name])} of {total} frames, the first of them frame {first} "
                f"({first / fps:.2f} s): it dropped or damaged them, and the others alone see what happens there; "
                "film with a faster card or a lower data rate."
            )
        if 0 < end < total:
            sentences.append(
                f"Camera {name!r} ends with frame {end - 1} ({(end - 1) / fps:.2f} s) and is absent from the "
                f"{total - end} frames after that; use the frames before, or leave it out."
            )
        if sentences:
            findings.append(Finding("warning", " ".join(sentences), (name,)))
    if len(dropping) > MAX_SINGLE:
        names = sorted(dropping, key=lambda name: -len(dropping[name]))
        shown = ", ".join(f"{name!r} {len(dropping[name])}" for name in names)
        sentence = (
            f"{len(names)} cameras lack some of {max(map(len, presence.values()))} frames ({shown}): they dropped or "
            "damaged them, and the others alone see what happens there; film with faster cards or a lower data rate."
        )
        findings.append(Finding("warning", sentence, tuple(names)))
    if late := tuple(name for name, own in presence.items() if own.any() and not own[0]):
        findings.append(_without_start(late, presence))
    return findings


def _passed(own: Sequence[int | None], stamps: Sequence[int]) -> Indices:
    """Of the ``own`` stamps of frames the gaps in which the file, with all ``stamps``, lacks no picture."""
    frames = np.flatnonzero([stamp is not None for stamp in own])
    if len(frames) < 2:
        return np.empty(0, np.intp)
    taken = np.array([stamp for stamp in own if stamp is not None])
    lost = np.round(np.diff(taken) / np.median(np.diff(stamps))) - 1
    whole = np.flatnonzero((np.diff(frames) > 1) & (lost <= 0))
    return np.concatenate([np.arange(frames[at] + 1, frames[at + 1]) for at in whole] or [np.empty(0, np.intp)])


def _slack(frames: int, fps: float) -> int:
    """Frames that a camera may lack at the end: half a second or 5 % of the take, whichever is more, and never more
    than a quarter of it."""
    return round(min(max(LOST_SECONDS * fps, LOST_SHARE * frames), MAX_LOST_SHARE * frames))


def _without_start(late: tuple[str, ...], presence: Presence) -> Finding:
    """Which cameras lack frame 0, and with which frame to begin: the first that most cameras have."""
    frames = min(map(len, presence.values()))
    counts = np.sum([own[:frames] for own in presence.values()], axis=0)
    first = int(counts.argmax())
    names = f"Camera{'s' * (len(late) > 1)} {', '.join(map(repr, late))}"
    advice = (
        f"begin with frame {first} (--start), which {counts[first]} of {len(presence)} cameras have"
        if first
        else "no frame has more cameras"
    )
    return Finding(
        "warning",
        f"{names} {'have' if len(late) > 1 else 'has'} no picture of frame 0, from which a stream learns the scene; "
        f"{advice}.",
        late,
    )


def _read(source: FrameSource, index: int, presence: Presence) -> MultiViewFrame:
    frame = next(source.frames(index))
    note(frame, presence)
    return frame
