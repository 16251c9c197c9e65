# SPDX-License-Identifier: Apache-2.0
"""What every test shares: one thread unless it says otherwise, torch's generator restored, the GPU marker."""

import os
from collections.abc import Iterator

import pytest
import torch


@pytest.fixture(autouse=True)
def quiet_randomness() -> Iterator[None]:
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    torch.manual_seed(0)
    yield
    torch.set_rng_state(state)
    torch.set_num_threads(threads)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if torch.cuda.is_available() or os.environ.get("STRUCTGSTREAM_REQUIRE_CUDA"):
        return
    skip = pytest.mark.skip(reason="no NVIDIA GPU on this machine")
    for item in items:
        if item.get_closest_marker("needs_cuda"):
            item.add_marker(skip)
