# SPDX-License-Identifier: Apache-2.0
"""Where groups begin: at equal distances, or near them where little moves."""

from collections.abc import Mapping

from structgstream.errors import ConfigError


def check_length(length: int, *, key_interval: int) -> None:
    """Check that groups of ``length`` frames begin where the stream has key packets anyway.

    Raises:
        ConfigError: they do not, so that every group would cost a key packet more.
    """
    if length < 1 or length % key_interval:
        near = max(1, round(length / key_interval)) * key_interval
        raise ConfigError(
            f"Groups of {length} frames cost a key packet each, because the stream has one every {key_interval} frames "
            f"(key_interval_seconds); take {near}, or another multiple, or add --allow-unaligned to pay for them."
        )


def equal_groups(frames: int, length: int) -> list[tuple[int, int]]:
    """Groups ``(first frame, end)`` of ``length`` frames; the last may be shorter, or one frame longer.

    A last frame by itself goes to the group before: handing over needs a group's second frame (``hand_over.py``).
    """
    firsts = [*range(0, frames, length)]
    if length > 1 and len(firsts) > 1 and frames - firsts[-1] == 1:
        firsts.pop()
    return [*zip(firsts, [*firsts[1:], frames], strict=True)]


def quiet_groups(frames: int, length: int, changed: Mapping[int, float]) -> list[tuple[int, int]]:
    """Groups of about ``length`` frames that begin where little moves.

    Of all divisions into groups of at least half and at most one and a half times ``length``, the one in which the
    sum of ``changed`` over the borders is least for their number; the last group may be shorter, but has at least
    two frames.

    Args:
        frames: of all groups.
        length: wanted.
        changed: share of pixels that changed, by frame at which a group may begin.
    """
    least, most = (length + 1) // 2, length + length // 2
    mean = sum(changed.values()) / max(len(changed), 1)
    # A border costs its change and, so that there are about frames / length of them, the mean of all.
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
