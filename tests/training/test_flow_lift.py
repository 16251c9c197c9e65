# SPDX-License-Identifier: Apache-2.0
"""2D flow of the training views, lifted to 3D displacements: who shares it, and what counts as none."""

from dataclasses import replace

import torch

from structgstream.training.online.measure import FlowEvidence
from structgstream.training.online.scene_flow import lift_flow
from structgstream.training.views import View
from tests.support.backends import quickest_backend
from tests.support.worlds import moving_world

BACKEND = quickest_backend()


def views_of_world() -> list[View]:
    return moving_world(2, cameras=6, width=128, height=96).views(1)


def test_neighbours_of_another_colour_do_not_share_a_motion() -> None:
    """A red ball beside a hand: ball and hand have flows of their own, and lie among each other."""
    views = views_of_world()
    generator = torch.Generator().manual_seed(0)
    centers = 0.05 * torch.randn(40, 3, generator=generator)
    ball = torch.arange(40) < 20
    colors = torch.where(ball[:, None], torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.7, 0.6, 0.5]))
    # The ball moves to the right in all pictures, the hand rests.
    flows = torch.where(ball[:, None], torch.tensor([6.0, 0.0]), torch.tensor([0.0, 0.0]))

    evidence = FlowEvidence(torch.full((len(views), 40), 5.0), flows.expand(len(views), -1, 2), colors)
    lifted = lift_flow(evidence, centers, torch.zeros(40, 3), views, backend=BACKEND)
    lengths = lifted.displacements.norm(dim=1)
    assert lengths[~ball].mean() < 0.05 * lengths[ball].mean()


def test_the_same_motion_is_lifted_alike_at_the_sizes_at_which_people_film() -> None:
    """Errors of a share of the width: at 640 pixels 1.2 of them, at 1920 pixels 3.6."""
    views = views_of_world()
    generator = torch.Generator().manual_seed(1)
    centers, flows = 0.1 * torch.randn(60, 3, generator=generator), torch.tensor([3.0, -2.0])
    errors = torch.randn(len(views), 60, 2, generator=generator)

    def lifted_at(width: int) -> tuple[torch.Tensor, torch.Tensor]:
        sized = [replace(view, camera=view.camera.resized(width, width * 3 // 4)) for view in views]
        seen = (flows + 0.85 * errors) * (width / 640)
        evidence = FlowEvidence(torch.full((len(views), 60), 5.0), seen, torch.full((60, 3), 0.5))
        found = lift_flow(evidence, centers, torch.zeros(60, 3), sized, backend=BACKEND)
        return found.displacements, found.lifted

    small, lifted = lifted_at(640)
    assert lifted.float().mean() > 0.9
    for width in (1280, 1920):
        large, also = lifted_at(width)
        assert torch.equal(lifted, also)
        torch.testing.assert_close(large, small, atol=1e-5, rtol=1e-3)


def test_without_evidence_movers_follow_their_priors() -> None:
    views = views_of_world()
    nothing = FlowEvidence(torch.zeros(len(views), 4), torch.zeros(len(views), 4, 2), torch.zeros(4, 3))
    priors = torch.rand(4, 3)
    found = lift_flow(nothing, torch.zeros(4, 3), priors, views, backend=BACKEND)
    assert torch.equal(found.displacements, priors)
    assert not found.lifted.any()
