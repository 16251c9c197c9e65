# SPDX-License-Identifier: Apache-2.0
"""The C++ generation of structured Gaussians beside its oracle in float64."""

import pytest
import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels import cpu_anchors, reference_anchors
from structgstream.kernels.values import Anchors, HeadWeights, MLPWeights, StructuredGaussians, TileSelection, tile_grid
from tests.parity.conftest import check_any_threads
from tests.support.backends import needs_native
from tests.support.splats import viewport_of

pytestmark = needs_native

# Positions of the tensors that online training moves: x_v, l_v, the covariance head.
ONLINE = {0, 1, 13, 14, 15, 16}
EVERYTHING = set(range(17))


def tensors(m: int, k: int, *, distance_input: bool, d: int = 32, hidden: int = 32) -> list[Tensor]:
    """Five anchor tensors and the twelve weights of the heads, with opacities of both signs."""
    inputs = d + 3 + int(distance_input)
    found = [
        torch.randn(m, 3) * 2,
        torch.randn(m, 3) * 0.3 - 3,
        torch.randn(m, 3) * 0.3 - 3,
        torch.randn(m, k, 3),
        torch.randn(m, d),
    ]
    for outputs in (k, 3 * k, 7 * k):
        found += [torch.randn(hidden, inputs) * 0.25, torch.randn(hidden) * 0.1]
        found += [torch.randn(outputs, hidden) * 0.3, torch.randn(outputs) * 0.1]
    return found


def generate(module, values: list[Tensor], visible: Tensor, distance_input: bool) -> StructuredGaussians:
    heads = [HeadWeights(*values[5 + 4 * h : 9 + 4 * h]) for h in range(3)]
    center = torch.tensor([0.3, 0.2, -5.0], dtype=values[0].dtype)
    return module.activate_anchors(
        Anchors(*values[:5]), MLPWeights(*heads), center, visible, distance_input=distance_input
    )


def attributes(structured: StructuredGaussians) -> list[Tensor]:
    g = structured.gaussians
    return [g.means, g.quats, g.scales, g.opacities, g.colors]


def run(
    module,
    values: list[Tensor],
    visible: Tensor,
    distance_input: bool,
    cotangents: list[Tensor],
    *,
    trained: set[int] = EVERYTHING,
    used: tuple[int, ...] = (0, 1, 2, 3, 4),
) -> tuple[StructuredGaussians, dict[int, Tensor]]:
    """Attributes, and the gradients of the tensors in ``trained`` from those attributes that are ``used``."""
    leaves = [value.clone().requires_grad_(i in trained) for i, value in enumerate(values)]
    gaussians = generate(module, leaves, visible, distance_input)
    outputs = attributes(gaussians)
    names = sorted(trained)
    gradients = torch.autograd.grad(
        [outputs[i] for i in used],
        [leaves[i] for i in names],
        [cotangents[i].to(values[0].dtype) for i in used],
        allow_unused=True,
        materialize_grads=True,
    )
    return gaussians, dict(zip(names, gradients, strict=True))


def cotangents_of(values: list[Tensor], visible: Tensor, distance_input: bool) -> list[Tensor]:
    return [torch.randn_like(x) for x in attributes(generate(reference_anchors, values, visible, distance_input))]


def relative_error(value: Tensor, exact: Tensor) -> float:
    return float((value.detach().double() - exact.detach()).norm() / exact.detach().norm().clamp_min(1e-12))


# k, distance, feature size, hidden width: the paper's, Scaffold-GS's, and widths that fill no vector.
@pytest.mark.parametrize(
    ("m", "k", "distance_input", "d", "hidden"),
    [
        (700, 5, True, 32, 32),
        (350, 10, False, 32, 32),
        (100, 3, False, 8, 16),
        (50, 4, True, 5, 40),
        (1, 5, True, 32, 32),
    ],
)
def test_attributes_and_gradients(isa: int, m: int, k: int, distance_input: bool, d: int, hidden: int) -> None:
    values = tensors(m, k, distance_input=distance_input, d=d, hidden=hidden)
    if m == 1:
        values[8].fill_(0.5)  # the opacity head's last bias: the only anchor draws something
    visible = (torch.arange(m) % 7 != 3).nonzero()[:, 0]
    cotangents = cotangents_of(values, visible, distance_input)
    exact_values = [value.double() for value in values]
    ours, gradients = run(cpu_anchors, values, visible, distance_input, cotangents)
    exact, exact_gradients = run(reference_anchors, exact_values, visible, distance_input, cotangents)
    assert len(ours.gaussians) > 0
    assert torch.equal(ours.gaussians.ids, exact.gaussians.ids)
    assert torch.equal(ours.anchors, visible)
    assert (ours.raw_opacities - exact.raw_opacities).abs().max() < 1e-5
    assert not ours.raw_opacities.requires_grad
    for value, wanted in zip(attributes(ours), attributes(exact), strict=True):
        assert relative_error(value, wanted) < 1e-6
    for index, wanted in exact_gradients.items():
        assert relative_error(gradients[index], wanted) < 5e-6, index


@pytest.mark.parametrize("trained", [ONLINE, {0}, {1}, {2}, {3}, {4}, {5, 6, 7, 8}, {9, 10, 11, 12}])
def test_frozen_tensors_change_nothing_for_the_others(trained: set[int]) -> None:
    values, visible = tensors(300, 5, distance_input=True), torch.arange(300)
    cotangents = cotangents_of(values, visible, True)
    _, everything = run(cpu_anchors, values, visible, True, cotangents)
    _, some = run(cpu_anchors, values, visible, True, cotangents, trained=trained)
    for index, gradient in some.items():
        assert relative_error(gradient, everything[index].double()) < 1e-6, index


@pytest.mark.parametrize("used", [(0,), (1, 2), (3,), (4,)])
def test_attributes_that_no_loss_uses(used: tuple[int, ...]) -> None:
    values, visible = tensors(60, 5, distance_input=True), torch.arange(60)
    cotangents = cotangents_of(values, visible, True)
    exact_values = [value.double() for value in values]
    _, ours = run(cpu_anchors, values, visible, True, cotangents, used=used)
    _, exact = run(reference_anchors, exact_values, visible, True, cotangents, used=used)
    for index, wanted in exact.items():
        assert relative_error(ours[index], wanted) < 5e-6, index


def test_bitwise_equal_for_any_number_of_threads(isa: int) -> None:
    values, visible = tensors(3000, 5, distance_input=True), torch.arange(0, 3000, 2)
    cotangents = cotangents_of(values, visible, True)

    def results() -> list[Tensor]:
        gaussians, gradients = run(cpu_anchors, values, visible, True, cotangents)
        return [*attributes(gaussians), gaussians.gaussians.ids, gaussians.raw_opacities, *gradients.values()]

    check_any_threads(results, (1, 2, 3, 2))


def test_no_visible_anchor() -> None:
    values, visible = tensors(20, 5, distance_input=True), torch.zeros(0, dtype=torch.int64)
    cotangents = cotangents_of(values, visible, True)
    ours, gradients = run(cpu_anchors, values, visible, True, cotangents)
    assert ours.gaussians.ids.shape == (0,)
    assert ours.gaussians.means.shape == (0, 3)
    assert ours.raw_opacities.shape == (0, 5)
    assert all(gradients[index].shape == values[index].shape for index in gradients)
    assert all((gradient == 0).all() for gradient in gradients.values())


def test_no_positive_opacity() -> None:
    values, visible = tensors(40, 5, distance_input=True), torch.arange(40)
    values[8].fill_(-20.0)
    cotangents = cotangents_of(values, visible, True)
    ours, gradients = run(cpu_anchors, values, visible, True, cotangents)
    assert len(ours.gaussians) == 0
    assert (ours.raw_opacities < 0).all()
    assert all((gradient == 0).all() for gradient in gradients.values())


def test_anchors_out_of_sight_get_no_gradient() -> None:
    values, visible = tensors(40, 5, distance_input=True), torch.arange(10, 30)
    _, gradients = run(cpu_anchors, values, visible, True, cotangents_of(values, visible, True))
    for index in range(5):
        assert (gradients[index][:10] == 0).all()
        assert (gradients[index][30:] == 0).all()
        assert (gradients[index][10:30] != 0).any()


def test_extreme_outputs_stay_finite(isa: int) -> None:
    values, visible = tensors(64, 5, distance_input=True), torch.arange(64)
    for index in (7, 11, 15):
        values[index] *= 1e4
    ours, gradients = run(cpu_anchors, values, visible, True, cotangents_of(values, visible, True))
    assert all(torch.isfinite(x).all() for x in [*attributes(ours), *gradients.values()])
    assert ours.gaussians.opacities.max() <= 1.0
    assert ours.gaussians.colors.min() >= 0.0


@pytest.mark.parametrize("module", [cpu_anchors, reference_anchors])
def test_an_anchor_in_the_camera_spoils_nothing(module) -> None:
    values, visible = tensors(8, 5, distance_input=True), torch.arange(8)
    values[0][3] = torch.tensor([0.3, 0.2, -5.0])
    ours, gradients = run(module, values, visible, True, cotangents_of(values, visible, True))
    assert all(torch.isfinite(x).all() for x in [*attributes(ours), *gradients.values()])


def test_what_it_cannot_generate_from() -> None:
    values, visible = tensors(10, 5, distance_input=True), torch.arange(10)
    with pytest.raises(BackendError, match="float64"):
        generate(cpu_anchors, [value.double() for value in values], visible, True)
    with pytest.raises(BackendError, match=r"of shape \(32, 35\)"):
        generate(cpu_anchors, values, visible, False)


@pytest.mark.parametrize("tiled", [False, True])
def test_culling(isa: int, tiled: bool) -> None:
    values = tensors(1003, 5, distance_input=True)
    values[1] -= 1.0
    values[2] -= 1.5
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([0.2, -0.1, 1.0])
    K = torch.tensor([[90.0, 0, 50], [0, 95.0, 41], [0, 0, 1]])
    tiles = TileSelection(torch.rand(tile_grid(101, 77)) < 0.2, 101, 77) if tiled else None
    found = [
        module.visible_anchors(
            Anchors(*(tensor.to(dtype) for tensor in values[:5])),
            viewport_of(viewmat.to(dtype), K.to(dtype), width=101, height=77, near=0.3),
            tiles,
        )
        for module, dtype in ((cpu_anchors, torch.float32), (reference_anchors, torch.float64))
    ]
    assert 20 < len(found[1]) < 900
    assert torch.equal(*found)
    assert found[0].dtype == found[1].dtype == torch.int64
    assert (found[0].diff() > 0).all()
