# SPDX-License-Identifier: Apache-2.0
import time

import pytest

from structgstream.training.result import Stopwatch


def test_stages_add_up_and_survive_errors() -> None:
    watch = Stopwatch()
    with watch.stage("one"):
        time.sleep(0.002)
    with watch.stage("one"):
        time.sleep(0.002)
    with pytest.raises(RuntimeError), watch.stage("two"):
        raise RuntimeError
    assert watch.seconds["one"] >= 0.004
    assert "two" in watch.seconds
