# SPDX-License-Identifier: Apache-2.0
"""Plain Gaussians: their colours by direction, and the way to the capture's units."""

import math

import torch

from structgstream.cameras import Similarity
from structgstream.exporters.bake import BakedGaussians
from structgstream.geometry import quaternion_matrices
from structgstream.harmonics import Y0
from structgstream.kernels.backend import reference_backend
from tests.support.plain import some
from tests.support.rigs import arc_rig


def two(sh: torch.Tensor) -> BakedGaussians:
    """At ``z`` = 2 and at ``x`` = 2."""
    return BakedGaussians(
        means=torch.tensor([[0.0, 0.0, 2.0], [2.0, 0.0, 0.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.6, 0.8, 0.0, 0.0]]),
        scales=torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]),
        opacities=torch.tensor([0.3, 0.9]),
        sh=sh,
    )


def test_colours_by_hand() -> None:
    """Seen from the origin along ``z`` and ``x``: their harmonics are ``sqrt(3 / 4 pi)`` times 1 and -1."""
    sh = torch.zeros(2, 4, 3)
    sh[:, 0, 0], sh[:, 2, 1], sh[:, 3, 2] = 1.0, 0.5, 0.25
    sh[:, 0, 2] = -0.4
    first = math.sqrt(3 / (4 * math.pi))
    red, blue = 0.5 + Y0, 0.5 - 0.4 * Y0
    expected = [[red, 0.5 + 0.5 * first, blue], [red, 0.5, blue - 0.25 * first]]
    torch.testing.assert_close(two(sh).colors(torch.zeros(3)), torch.tensor(expected))
    sh[:, 0] = -9.0
    assert torch.equal(two(sh).colors(torch.zeros(3)), torch.zeros(2, 3)), "cut off at 0"


def test_a_camera_sees_the_colours_of_its_place() -> None:
    sh = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(0)) * 0.2
    camera = arc_rig()["cam01"]
    seen = two(sh).gaussians(camera, reference_backend())
    assert torch.equal(seen.colors, two(sh).colors(camera.center.float()))
    assert seen.ids.tolist() == [0, 1]


def test_y_up_shows_the_same_to_a_camera_that_is_turned_alike() -> None:
    gaussians = some(20, degree=3)
    center = torch.tensor([0.3, 2.0, -4.0])
    turned = gaussians.y_up()
    half_turn = torch.tensor([1.0, -1.0, -1.0])
    torch.testing.assert_close(turned.colors(center * half_turn), gaussians.colors(center))
    axes, wanted = (quaternion_matrices(g.quats) * g.scales[:, None] for g in (turned, gaussians))
    turn = torch.diag(half_turn)
    torch.testing.assert_close(axes @ axes.mT, turn @ wanted @ wanted.mT @ turn)


def test_in_the_units_of_the_capture() -> None:
    """Normalised = (capture - center) * scale, so back it is divided and moved; axes and colours stay."""
    both = two(torch.zeros(2, 1, 3))
    found = both.in_capture_units(Similarity((1.0, -2.0, 3.0), 0.5))
    torch.testing.assert_close(found.means, torch.tensor([[1.0, -2.0, 7.0], [5.0, -2.0, 3.0]]))
    torch.testing.assert_close(found.scales, both.scales * 2.0)
    assert found.quats is both.quats
    assert found.means.dtype == torch.float32
