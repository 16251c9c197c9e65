# SPDX-License-Identifier: Apache-2.0
"""What a change remembers of the rows that it changed."""

import numpy as np

from structgstream.codec.fields.packet_fields import Change, row_sizes

RESIDUALS = np.array([[0, 0], [1, -2], [300, 300], [0, -1]], np.int32)


def test_a_change_of_residuals_knows_rows_and_sizes() -> None:
    change = Change.of(RESIDUALS)
    assert change.active.tolist() == [False, True, True, True]
    assert change.sizes.tolist() == row_sizes(RESIDUALS).tolist() == [0, 3, 510, 1]
    none = Change.none(4, 2)
    assert not none.active.any()
    assert none.sizes.tolist() == [0] * 4
    assert none.residuals.shape == (4, 2)


def test_rows_that_stay_keep_their_change_and_new_ones_have_none() -> None:
    change = Change.of(RESIDUALS).select(np.array([False, True, False, True])).extended(2)
    assert change.residuals.tolist() == [[1, -2], [0, -1], [0, 0], [0, 0]]
    assert change.history.tolist() == [1, 1, 0, 0]
    assert change.sizes.tolist() == [3, 1, 0, 0]


def test_only_the_last_frame_makes_a_row_active() -> None:
    """Bit 0 of the history; the others are of frames before."""
    change = Change(np.zeros((3, 1), np.int32), np.array([1, 2, 6], np.uint8), np.zeros(3, np.int32))
    assert change.active.tolist() == [True, False, False]
