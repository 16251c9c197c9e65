# SPDX-License-Identifier: Apache-2.0
"""First frames of groups: at equal distances, or near these at frames with little motion."""

from collections.abc import Mapping

from structgstream.errors import ConfigError


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
