# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.gaussians import Gaussians, concatenate
from structgstream.kernels.backend import reference_backend
from tests.support.rigs import arc_rig, random_scene


def test_concatenation_keeps_rows_and_ids_together() -> None:
    gaussians = random_scene(free=4).gaussians(arc_rig()["cam01"], reference_backend())
    n = len(gaussians)
    parts = [
        Gaussians(**{name: value[rows] for name, value in gaussians.columns().items()})
        for rows in (slice(0, n // 3), slice(n // 3, n))
    ]
    again = concatenate(*parts)
    assert len(again) == n
    assert all(torch.equal(value, vars(again)[name]) for name, value in gaussians.columns().items())
