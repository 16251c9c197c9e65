# SPDX-License-Identifier: Apache-2.0
"""First frames of groups: at equal distances, or near these at frames with little motion; and the list of groups.

The list is a text file next to a track: one ``a:b`` per line, from frame a to before frame b.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.errors import ConfigError, StreamError

Groups = Sequence[tuple[int, int]]
"""First frame and end of each group, in order."""


def groups_path(track: Path) -> Path:
    """The path of a track's list."""
    return track.with_name(f"{track.name}.groups")


def write_groups(track: Path, groups: Groups) -> None:
    """Writes the list of a track atomically.

    Raises:
        StorageError: it cannot be written.
    """
    atomic_write(groups_path(track), "".join(f"{first}:{end}\n" for first, end in groups).encode())


def read_groups(track: Path) -> Groups | None:
    """The groups of a track of a whole capture; None while the pass has not chosen them.

    Raises:
        StreamError: the list has gaps or does not follow the format.
    """
    path = groups_path(track)
    try:
        text = path.read_text(errors="replace")
    except OSError:
        return None
    if not text.endswith("\n"):
        return None
    try:
        groups = [(int(first), int(end)) for first, _, end in (line.partition(":") for line in text.split())]
    except ValueError:
        raise StreamError(f"{path} has no groups, 'first:end' a line.") from None
    borders = [0, *(end for _, end in groups)]
    if not groups or [first for first, _ in groups] != borders[:-1] or borders != sorted(set(borders)):
        raise StreamError(f"The groups in {path} do not follow each other from frame 0 on.")
    return groups


def check_length(length: int, *, key_interval: int) -> None:
    """Check that groups of ``length`` frames begin at frames that are key packets anyway.

    Raises:
        ConfigError: they do not, so every group would cost an additional key packet.
    """
    if length < 1 or length % key_interval:
        near = max(1, round(length / key_interval)) * key_interval
        raise ConfigError(
            f"Groups of {length} frames cost a key packet each, because the stream has one every {key_interval} frames "
            f"(key_interval_seconds); take {near}, or another multiple, or add --allow-unaligned to pay for them."
        )


def equal_groups(frames: int, length: int) -> list[tuple[int, int]]:
    """Groups ``(first frame, end)`` of ``length`` frames; the last may be shorter, or one frame longer.

    A single frame at the end joins the group before, because a seam blend needs a group's second frame
    (``seam_blend.py``).
    """
    firsts = [*range(0, frames, length)]
    if length > 1 and len(firsts) > 1 and frames - firsts[-1] == 1:
        firsts.pop()
    return [*zip(firsts, [*firsts[1:], frames], strict=True)]


def quiet_groups(frames: int, length: int, changed: Mapping[int, float]) -> list[tuple[int, int]]:
    """Groups of about ``length`` frames that begin at frames with little motion.

    Every group has at least half and at most one and a half times ``length`` frames; the last may be shorter, but has
    at least two. Among all such divisions, this one minimizes the sum of ``changed`` over the borders, relative to
    their number.

    Args:
        frames: number of frames in all groups.
        length: wanted frames per group.
        changed: share of pixels that changed, by frame at which a group may begin.
    """
    least, most = (length + 1) // 2, length + length // 2
    mean = sum(changed.values()) / max(len(changed), 1)
    # The cost of a border is its change plus the mean of all changes, so that about frames / length borders are chosen.
    best: dict[int, tuple[float, int]] = {0: (0.0, -1)}
    for frame in sorted(changed):
        found = [(cost, first) for first, (cost, _) in best.items() if least <= frame - first <= most]
        if found and frame < frames:
            cost, first = min(found)
            best[frame] = (cost + changed[frame] + mean, first)
    ends = [
        (cost, first)
        for first, (cost, _) in best.items()
        if frames - first <= most and (frames - first > 1 or not first)
    ]
    if not ends:
        return equal_groups(frames, length)
    first, end, groups = min(ends)[1], frames, []
    while first >= 0:
        groups.append((first, end))
        first, end = best[first][1], first
    return groups[::-1]
