# SPDX-License-Identifier: Apache-2.0
"""Detection of outlier views: failing or moved cameras, and global changes of light.

A view is an outlier in four cases. Its picture changed, or has large residuals, nearly everywhere while the median
view did not. Or it has many times the large residuals of the median view, as of a camera that was bumped, whose picture
stays right where it shows plain surfaces. Or it has several times them and its picture is shifted as a whole, as of a
bumped camera that shows little else. Or it is the last one once more while others changed: the camera is frozen. If
most views changed everywhere, motion between the frames cannot be segmented.

The median needs a majority, and two views are left at least: of two views none can be an outlier, and of three none is
taken for frozen, as two of three may show nothing that moves (:func:`unrecognized_faults`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

WHOLE_PICTURE_SHARE = 0.5
"""Share of changed, or wrong, pixels above which a picture counts as changed, or wrong, everywhere."""
MEDIAN_SHARE = 0.25
"""An outlier requires that the median view's share is below this."""
BUMPED_SHARE, BUMPED_TIMES = 0.2, 8.0
"""Least share of wrong pixels of a bumped camera, and least multiple of the median view's."""
SUSPECT_SHARE, SUSPECT_TIMES = 0.02, 3.0
"""Least share of wrong pixels of a view whose shift is looked for, and least multiple of the median view's."""
SHIFTED_PIXELS = 2.5
"""Least shift of a whole picture, in pixels of a picture of the reference size. In basketball's 60 frames it is found
to be 1.5 at most, and 4 or more of pictures that were shifted by 5 and 3 pixels."""
CLEAR_SHIFT = 0.3
"""Least clarity of a shift, 0 to 1 (``flow.picture_shift``); basketball's are 0.53 or more."""
FROZEN_SHARE = 0.005
"""Least share of changed pixels in the median view for a repeated picture to count as frozen; at most one view in
four may be."""

FEW_VIEWS = 3
"""Up to this many views cannot show every fault of one of them."""


@dataclass(frozen=True)
class ViewChange:
    """Change of one view's picture.

    Args:
        changed_share: share of its pixels that changed since the last frame; None if the camera was absent from that.
        wrong_share: share of its pixels with a residual above frame 0's.
        repeated: whether it is the last picture once more (``picture_change``).
        shift_pixels: how far the picture is shifted as a whole, at the reference size; known of suspects only
            (:func:`suspects`).
    """

    changed_share: float | None
    wrong_share: float
    repeated: bool
    shift_pixels: float = 0.0


def suspects(changes: Sequence[ViewChange]) -> list[int]:
    """The views that have several times the wrong pixels of the median view: their shift is worth looking for."""
    least = max(SUSPECT_SHARE, SUSPECT_TIMES * median(c.wrong_share for c in changes))
    return [number for number, change in enumerate(changes) if change.wrong_share > least]


def trusted_views(changes: Sequence[ViewChange]) -> list[bool]:
    """For each view whether it is no outlier. If fewer than two views are left, none counts as an outlier."""
    usual_change, usual_wrong = _usual_change(changes), median(c.wrong_share for c in changes)
    few_same = 4 * sum(c.repeated for c in changes) <= len(changes)
    found = [
        not (
            ((c.changed_share or 0.0) > WHOLE_PICTURE_SHARE and usual_change < MEDIAN_SHARE)
            or (c.wrong_share > WHOLE_PICTURE_SHARE and usual_wrong < MEDIAN_SHARE)
            or c.wrong_share > max(BUMPED_SHARE, BUMPED_TIMES * usual_wrong)
            or c.shift_pixels > SHIFTED_PIXELS
            or (c.repeated and few_same and usual_change > FROZEN_SHARE)
        )
        for c in changes
    ]
    return found if sum(found) >= 2 else [True] * len(found)


def unrecognized_faults(views: int) -> str | None:
    """A sentence on the faults of cameras that so many training views cannot show; None where they can show all."""
    if views > FEW_VIEWS:
        return None
    fault = "fails, is frozen or was bumped" if views < FEW_VIEWS else "is frozen"
    return f"With {views} training cameras one that {fault} cannot be recognised; that takes {FEW_VIEWS + 1} or more."


def is_scene_cut(changes: Sequence[ViewChange]) -> bool:
    """Whether most pictures changed everywhere, so that motion cannot be segmented."""
    return _usual_change(changes) > WHOLE_PICTURE_SHARE


def _usual_change(changes: Sequence[ViewChange]) -> float:
    """Median share of changed pixels, over the views that know theirs."""
    return median(c.changed_share for c in changes if c.changed_share is not None)
