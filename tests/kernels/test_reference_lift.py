# SPDX-License-Identifier: Apache-2.0
"""The oracle of lifting flow, where the displacement is known."""

import torch

from structgstream.kernels import reference_motion
from structgstream.kernels.reference_motion import lift, projection_jacobians
from structgstream.kernels.values import Neighbors, ViewFlows

MOTION = torch.tensor([0.03, -0.02, 0.01], dtype=torch.float64)
VIEWS, MOVERS = 5, 30


def cameras() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    viewmats = torch.eye(4, dtype=torch.float64).repeat(VIEWS, 1, 1)
    for v in range(VIEWS):
        angle = torch.tensor(0.3 * v, dtype=torch.float64)
        c, s = float(angle.cos()), float(angle.sin())
        viewmats[v, :3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        viewmats[v, 2, 3] = 2.0
    K = torch.tensor([[300.0, 0, 160], [0, 310.0, 120], [0, 0, 1]], dtype=torch.float64)
    return viewmats, K.repeat(VIEWS, 1, 1), torch.full((VIEWS,), 0.1, dtype=torch.float64)


def centers() -> torch.Tensor:
    return 0.2 * torch.randn(MOVERS, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def projected(points: torch.Tensor) -> torch.Tensor:
    viewmats, Ks, _ = cameras()
    seen = torch.einsum("vij,ej->vei", viewmats[:, :3, :3], points) + viewmats[:, None, :3, 3]
    pixels = torch.einsum("vij,vej->vei", Ks, seen)
    return pixels[..., :2] / pixels[..., 2:]


def flow_of(motion: torch.Tensor) -> torch.Tensor:
    """Flow ``[V, E, 2]`` of all points under one displacement, linearised as ``lift`` has it."""
    return projection_jacobians(centers(), *cameras()) @ motion


def lifted(flows: torch.Tensor, weights: torch.Tensor | None = None, prior: torch.Tensor | None = None):
    viewmats, Ks, near = cameras()
    return lift(
        centers(),
        ViewFlows(torch.full_like(flows[..., 0], 5.0) if weights is None else weights, flows, viewmats, Ks, near),
        Neighbors(torch.arange(MOVERS)[:, None], torch.ones(MOVERS, 1, dtype=torch.float64)),
        torch.zeros(MOVERS, 3, dtype=torch.float64) if prior is None else prior,
        share=0.4,
    )


def test_the_jacobian_is_that_of_the_projection() -> None:
    points = centers()[:4]
    step = 1e-6
    found = projection_jacobians(points, *cameras())
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        slope = (projected(points + shift) - projected(points - shift)) / (2 * step)
        torch.testing.assert_close(found[..., axis], slope, atol=1e-4, rtol=1e-6)


def test_flow_of_a_known_motion_gives_the_motion() -> None:
    found = lifted(flow_of(MOTION))
    # The pull towards no motion is two per cent of the flow's.
    torch.testing.assert_close(found.displacements, MOTION.expand(MOVERS, 3), atol=2e-3, rtol=0.1)
    assert (found.inlier_share > 0.99).all()
    assert (found.agreeing_views == VIEWS).all()


def test_a_view_whose_flow_is_wrong_is_outvoted() -> None:
    flows = flow_of(MOTION)
    flows[2] += 12.0
    found = lifted(flows)
    torch.testing.assert_close(found.displacements, MOTION.expand(MOVERS, 3), atol=3e-3, rtol=0.1)
    assert (found.agreeing_views == VIEWS - 1).all()
    torch.testing.assert_close(found.inlier_share, torch.full_like(found.inlier_share, 0.8))


def test_a_turning_ball_that_moves_by_40_pixels_is_lifted_whole(monkeypatch) -> None:
    """Its flow is right, but 40 pixels are not linear, and one displacement is fitted to neighbours that turn."""
    viewmats, Ks, near = cameras()
    generator = torch.Generator().manual_seed(3)
    skin = torch.nn.functional.normalize(torch.randn(60, 3, generator=generator, dtype=torch.float64), dim=1)
    ball = 0.12 * skin
    turn = torch.linalg.matrix_exp(0.25 * torch.tensor([[0, -1, 0.5], [1, 0, 0.3], [-0.5, -0.3, 0]]).double())
    by = torch.tensor([0.22, -0.14, 0.10], dtype=torch.float64)
    now = ball @ turn.T + by
    flows = projected(now) - projected(ball)
    assert flows.norm(dim=-1).mean() > 30.0
    distances = torch.cdist(ball, ball)
    rows = distances.argsort(1)[:, :12]
    near_by = distances.gather(1, rows)
    affinities = torch.exp(-0.5 * (near_by / (0.7 * near_by[:, -1:])).square())
    seen = ViewFlows(torch.full_like(flows[..., 0], 5.0), flows, viewmats, Ks, near)

    def lifted_share() -> float:
        found = lift(ball, seen, Neighbors(rows, affinities), torch.zeros_like(ball), share=0.4)
        whole = (found.inlier_share > 0.4) & (found.agreeing_views >= 2)
        errors = (found.displacements - (now - ball)).norm(dim=1)
        assert (errors[whole] < 0.2 * by.norm()).all()
        return float(whole.double().mean())

    assert lifted_share() == 1.0
    monkeypatch.setattr(reference_motion, "TOLERANCE_SHARE", 0.0)
    assert lifted_share() < 0.5, "a tolerance in pixels alone"


def test_where_nothing_moves_fast_an_error_of_three_pixels_is_outvoted() -> None:
    flows = flow_of(0.3 * MOTION)
    flows[2] += torch.tensor([3.0, 0.0])
    assert (lifted(flows).agreeing_views == VIEWS - 1).all()


def test_without_flow_the_prior_holds() -> None:
    prior = 0.1 * centers()
    found = lifted(torch.zeros(VIEWS, MOVERS, 2, dtype=torch.float64), torch.zeros(VIEWS, MOVERS).double(), prior)
    assert torch.equal(found.displacements, prior)
    assert not found.inlier_share.any()


def test_one_view_leaves_depth_to_the_prior() -> None:
    viewmats, _, _ = cameras()
    weights = torch.zeros(VIEWS, MOVERS, dtype=torch.float64)
    weights[0] = 5.0
    found = lifted(flow_of(MOTION), weights)
    along = torch.nn.functional.normalize(centers() - torch.linalg.inv(viewmats[0])[:3, 3], dim=1)
    assert ((found.displacements * along).sum(1).abs() < 0.002).all()
    assert (found.agreeing_views == 1).all()
