# SPDX-License-Identifier: Apache-2.0
"""Which pictures of a frame can be believed: cameras fail, are bumped, and somebody switches on the light.

One picture that has changed everywhere while the others hardly did tells of its camera, not of the scene; so does one
that is wrong everywhere, or equal to the last one to the bit while others changed. When all have changed everywhere,
nothing can be followed from one picture to the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

WHOLE_PICTURE_SHARE = 0.5
"""A picture has changed, or is wrong, everywhere when more than this share of it is."""
MEDIAN_SHARE = 0.25
"""... and that is the camera's doing when it is not so in the median view, by this share."""
FROZEN_SHARE = 0.005
"""So much must have changed in the median view for a picture without any change to count as frozen, which at most one
in four may be."""


@dataclass(frozen=True)
class ViewChange:
    """How one view's picture differs.

    Args:
        changed_share: share of its pixels that changed since the last frame.
        wrong_share: share of its pixels that the rendering misses beyond frame 0's residual.
        identical: whether it equals the last picture bit for bit.
    """

    changed_share: float
    wrong_share: float
    identical: bool


def trusted_views(changes: Sequence[ViewChange]) -> list[bool]:
    """For each view whether its picture tells of the scene. At least two views are believed, or all are."""
    usual_change, usual_wrong = median(c.changed_share for c in changes), median(c.wrong_share for c in changes)
    few_same = 4 * sum(c.identical for c in changes) <= len(changes)
    found = [
        not (
            (c.changed_share > WHOLE_PICTURE_SHARE and usual_change < MEDIAN_SHARE)
            or (c.wrong_share > WHOLE_PICTURE_SHARE and usual_wrong < MEDIAN_SHARE)
            or (c.identical and few_same and usual_change > FROZEN_SHARE)
        )
        for c in changes
    ]
    return found if sum(found) >= 2 else [True] * len(found)


def is_scene_cut(changes: Sequence[ViewChange]) -> bool:
    """Whether most pictures have changed everywhere: there is no motion to follow."""
    return median(c.changed_share for c in changes) > WHOLE_PICTURE_SHARE
