# SPDX-License-Identifier: Apache-2.0
"""The sweep along rays, where it is known what emerged; each back-end on its own."""

from collections.abc import Callable
from dataclasses import replace

import torch

from structgstream.kernels.backend import Backend
from structgstream.kernels.values import SweepView
from tests.support.backends import on_each_backend
from tests.support.rigs import arc_rig

RULES = {"planes": 65, "max_contradictions": 0.34}


def emerged() -> tuple[list[SweepView], torch.Tensor, torch.Tensor]:
    """A red disc of radius 0.25 in front of a grey wall has emerged at the origin, as four cameras see it."""
    rig, found = arc_rig(5, width=64, height=48), []
    for name in rig.training:
        camera = rig[name]
        matrices = camera.viewport(torch.zeros(1))
        center = matrices.viewmat[:3, 3]
        y, x = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
        u, v = (matrices.K @ center)[:2] / center[2]
        disc = ((x - u) ** 2 + (y - v) ** 2).sqrt() < 0.25 * matrices.K[0, 0] / center[2]
        colors = torch.where(disc[..., None], torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.5, 0.5, 0.5]))
        found.append(SweepView(colors, disc.float(), torch.full((48, 64), 6.0), matrices.viewmat, matrices.K, near=1.0))
    own = found[1]
    u, v = ((own.K @ own.viewmat[:3, 3])[:2] / own.viewmat[2, 3]).floor().long().tolist()
    return found, torch.tensor([[u, v]]), torch.tensor([6.0])


@on_each_backend
def test_what_emerged_is_found_where_it_is(build: Callable[[], Backend]) -> None:
    scene, *ray = emerged()
    found = build().sweep(scene, 1, *ray, **RULES, min_supports=2)
    center = float(scene[1].viewmat[2, 3])
    # Any depth at which the ray stays within the disc's image in all views is as good; the middle of them is taken.
    assert abs(float(found.depths) - center) < 0.15
    assert float(found.costs) < 0.03


@on_each_backend
def test_one_view_alone_is_contradicted(build: Callable[[], Backend]) -> None:
    scene, *ray = emerged()
    alone = [v if i == 1 else replace(v, missing=torch.zeros_like(v.missing)) for i, v in enumerate(scene)]
    found = build().sweep(alone, 1, *ray, **RULES, min_supports=1)
    assert float(found.depths) == 0.0
    assert torch.isinf(found.costs).all()


@on_each_backend
def test_what_is_hidden_has_no_vote(build: Callable[[], Backend]) -> None:
    """Behind what is rendered nothing can emerge: with a wall before the disc no point is supported."""
    scene, *ray = emerged()
    walled = [replace(v, depths=torch.full_like(v.depths, 1.5)) for v in scene]
    found = build().sweep(walled, 1, *ray, **RULES, min_supports=2)
    assert float(found.depths) < 1.7  # before the wall, or nowhere
