# SPDX-License-Identifier: Apache-2.0
"""Stamps of streams."""

import numpy as np
import pytest

from structgstream.preparation.synchronization.streams import StatesMetadata, period_seconds
from tests.support.takes import MadeStreams


def test_the_period_is_that_of_most_frames() -> None:
    assert period_seconds(np.delete(np.arange(50) / 25, [3, 4, 20])) == pytest.approx(0.04)
    assert period_seconds(np.zeros(1)) == pytest.approx(1 / 30)


def test_metadata_is_recognised() -> None:
    assert isinstance(MadeStreams({}), StatesMetadata)
    assert not isinstance(object(), StatesMetadata)
