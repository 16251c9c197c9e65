# SPDX-License-Identifier: Apache-2.0
"""Every rasteriser against the float64 reference, forward and gradient.

The scene stays away from where the definition jumps: depths are far apart, and pixels in which an alpha comes close to
1/255 or 0.999, or the transmittance to 1e-4 or 1/255, carry no cotangent. There a rounding error of the seventh digit
would decide which branch is taken, and the comparison would measure that instead of the kernel.
"""

import resource
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.errors import BackendError
from structgstream.kernels import cpu_raster, reference_raster
from structgstream.kernels.reference_raster import rasterize as reference
from structgstream.kernels.values import TileSelection, tile_grid
from tests.parity.conftest import check_any_threads
from tests.support.backends import needs_native
from tests.support.splats import splats_of, viewport_of

WIDTH, HEIGHT, NEAR = 75, 53, 0.2  # No multiple of the tile.
COLOURED = torch.tensor([0.3, 0.6, 0.1])
NAMES = ("means", "quats", "scales", "opacities", "colors", "screen_offsets")


def camera(dtype: torch.dtype = torch.float64, device: str = "cpu") -> Viewport:
    angle = torch.tensor(0.2, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = angle.cos()
    viewmat[0, 2], viewmat[2, 0] = angle.sin(), -angle.sin()
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    K = torch.tensor([[60.0, 0, 36.0], [0, 58.0, 27.0], [0, 0, 1]], dtype=torch.float64)
    viewmat, K = (value.to(device, dtype) for value in (viewmat, K))
    return viewport_of(viewmat, K, width=WIDTH, height=HEIGHT, near=NEAR)


@cache
def gaussians(count: int = 300) -> tuple[Tensor, ...]:
    """Not to be changed."""
    g = torch.Generator().manual_seed(7)
    depths = torch.linspace(1.0, 5.0, count, dtype=torch.float64)[torch.randperm(count, generator=g)]
    spread = torch.rand(count, 2, generator=g, dtype=torch.float64) * 2.0 - 1.0
    means = torch.cat([spread * depths[:, None] * 0.8, depths[:, None]], dim=1)
    viewmat = camera().viewmat
    means = (means - viewmat[:3, 3]) @ viewmat[:3, :3]  # Depths are the camera's, so they stay far apart.
    return (
        means,
        torch.randn(count, 4, generator=g, dtype=torch.float64),
        torch.exp(torch.randn(count, 3, generator=g, dtype=torch.float64) * 0.5 - 2.5),
        torch.rand(count, generator=g, dtype=torch.float64) * 0.7 + 0.05,
        torch.rand(count, 3, generator=g, dtype=torch.float64),
        torch.zeros(count, 2, dtype=torch.float64),
    )


def run(
    rasterize,
    inputs: tuple[Tensor, ...],
    *,
    background: Tensor | None = None,
    device: str = "cpu",
    intervals: Tensor | None = None,
    away: Tensor | None = None,
):
    """Image, alpha and the gradients for fixed cotangents in the pixels ``away``; None for those that are safe."""
    dtype = inputs[0].dtype
    leaves = [value.to(device).clone().requires_grad_() for value in inputs]
    output = rasterize(
        splats_of(*leaves[:5], intervals=None if intervals is None else intervals.to(device, dtype)),
        camera(dtype, device),
        screen_offsets=leaves[5],
        background=None if background is None else background.to(device, dtype),
    )
    g = torch.Generator().manual_seed(11)
    away = safe_pixels(inputs, intervals) if away is None else away
    v_image = torch.randn(HEIGHT, WIDTH, 3, generator=g, dtype=torch.float64) * away[..., None]
    v_alpha = torch.randn(HEIGHT, WIDTH, generator=g, dtype=torch.float64) * away
    total = (output.image * v_image.to(device, dtype)).sum() + (output.alpha * v_alpha.to(device, dtype)).sum()
    gradients = torch.autograd.grad(total, leaves)
    return output.image.detach().cpu(), output.alpha.detach().cpu(), [x.cpu() for x in gradients], output.radii.cpu()


def safe_pixels(inputs: tuple[Tensor, ...], intervals: Tensor | None = None) -> Tensor:
    """Mask ``[H, W]``: pixels that do not change when the definition's limits move by a little."""
    values = [value.double() for value in inputs]
    pictures = []
    saved = reference_raster.MIN_ALPHA, reference_raster.MAX_ALPHA, reference_raster.MIN_TRANSMITTANCE
    try:
        for factor in (1 - 1e-3, 1 + 1e-3):
            reference_raster.MIN_ALPHA = saved[0] * factor
            reference_raster.MAX_ALPHA = 1 - (1 - saved[1]) * factor
            reference_raster.MIN_TRANSMITTANCE = saved[2] * factor
            pictures.append(reference(splats_of(*values[:5], intervals=intervals), camera()).image)
        for factor in (1 - 1e-3, 1 + 1e-3):  # Stopping there shows in which pixels something begins to be faint.
            reference_raster.MIN_TRANSMITTANCE = reference_raster.MIN_GRADIENT_TRANSMITTANCE * factor
            pictures.append(reference(splats_of(*values[:5], intervals=intervals), camera()).image)
    finally:
        reference_raster.MIN_ALPHA, reference_raster.MAX_ALPHA, reference_raster.MIN_TRANSMITTANCE = saved
    apart = [(pictures[n] - pictures[n + 1]).abs().amax(-1) for n in (0, 2)]
    return (torch.maximum(*apart) < 1e-7).double()


@cache
def usual_safe_pixels() -> Tensor:
    return safe_pixels(gaussians())


@cache
def runs_of_reference(background: Tensor | None, share: float | None):
    """Pixels that are compared, and the results of the reference in float64 and in float32: as good as it gets."""
    inputs, intervals = gaussians(), None if share is None else intervals_at(share)
    away = safe_pixels(inputs, intervals)
    single = tuple(value.float() for value in inputs)
    options = {"background": background, "intervals": intervals, "away": away}
    return away, run(reference, inputs, **options), run(reference, single, **options)


def relative_errors(got: Tensor, truth: Tensor) -> Tensor:
    """Error of each Gaussian's gradient, relative to its own size plus a thousandth of the typical size."""
    got, truth = got.double().reshape(len(truth), -1), truth.double().reshape(len(truth), -1)
    size = truth.norm(dim=1)
    return (got - truth).norm(dim=1) / (size + 1e-3 * size.median() + 1e-12)


def check_against_reference(
    rasterize, *, background: Tensor | None, device: str = "cpu", share: float | None = None
) -> None:
    safe, (image, alpha, gradients, radii), (_, _, torch32, _) = runs_of_reference(background, share)
    away, intervals = safe.bool(), None if share is None else intervals_at(share)
    assert away.float().mean() > 0.5
    single = tuple(value.float() for value in gaussians())
    image32, alpha32, gradients32, radii32 = run(
        rasterize, single, background=background, device=device, intervals=intervals, away=safe
    )
    # Float32 sums of some tens of terms of size one: 1e-5 is 80 units in the last place.
    assert (image32 - image).abs()[away].max() < 1e-5
    assert (alpha32 - alpha).abs()[away].max() < 1e-5
    assert ((radii32 > 0) == (radii > 0)).float().mean() > 0.99  # A box may miss the picture by a rounding.
    for name, got, single, truth in zip(NAMES, gradients32, torch32, gradients):
        errors, autograd = relative_errors(got, truth), relative_errors(single, truth)
        # As good as torch's own float32 autograd on the same input, give or take the order of its sums.
        assert errors.median() < max(2e-5, 3 * autograd.median()), name
        assert errors.quantile(0.95) < max(2e-4, 3 * autograd.quantile(0.95)), name


@needs_native
@pytest.mark.parametrize("background", [None, COLOURED], ids=["black", "coloured"])
def test_cpu(isa: int, background: Tensor | None) -> None:
    check_against_reference(cpu_raster.rasterize, background=background)


def intervals_at(share: float) -> Tensor:
    """Training pixels of ``share`` of this picture's pixels at each of the Gaussians, give or take a third."""
    view = camera()
    depths = gaussians()[0] @ view.viewmat[2, :3] + view.viewmat[2, 3]
    around = torch.linspace(0.7, 1.3, len(depths), dtype=torch.float64)
    return share * around * depths / (view.K[0, 0] * view.K[1, 1]).sqrt()


@needs_native
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0, 3.0])
def test_the_low_pass_of_the_training_pictures_on_the_cpu(isa: int, share: float) -> None:
    """Pictures without training pixels, much smaller than the training pictures, as large, and three times as large."""
    intervals = intervals_at(share)
    check_against_reference(cpu_raster.rasterize, background=COLOURED, share=share)
    plain, filtered = (
        cpu_raster.rasterize(
            splats_of(*(v.float() for v in gaussians()[:5]), intervals=given), camera(torch.float32)
        ).image
        for given in (None, intervals.float())
    )
    assert (plain - filtered).abs().max() > 0.01


@needs_native
@pytest.mark.parametrize("rasterize", [reference, cpu_raster.rasterize], ids=["reference", "cpu"])
def test_what_hardly_any_light_reaches_is_drawn_without_gradient(isa: int, rasterize) -> None:
    """The first of three walls lets a thousandth of the light through."""
    _, quats, scales, _, _, _ = (value[:3].float() for value in gaussians())
    view = camera(torch.float32)
    depths = torch.tensor([[0.0, 0.0, depth] for depth in (2.0, 3.0, 4.0)])
    means = (depths - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]
    colors = torch.tensor([[0.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 0.0]])
    leaves = [x.clone().requires_grad_() for x in (means, quats, scales + 50.0, torch.tensor([1.0, 0.8, 0.8]), colors)]
    drawn = rasterize(splats_of(*leaves), view)
    assert drawn.image[HEIGHT // 2, WIDTH // 2, 1].item() == pytest.approx(0.08, rel=0.01)
    gradients = torch.autograd.grad(drawn.image.square().sum() + drawn.alpha.sum() + drawn.image.sum(), leaves)
    assert gradients[4][0].any()
    for name, gradient in zip(NAMES, gradients):
        assert not gradient[1:].any(), name


@needs_native
@pytest.mark.parametrize("faint", [False, True])
def test_no_pixel_of_a_needle_is_skipped(isa: int, faint: bool) -> None:
    """Blocks of pixels are chosen by a splat's ellipse: needles at every angle touch the corners of most."""
    means, quats, scales, opacities, colors, _ = gaussians(400)
    scales = torch.full_like(scales, 0.004)
    scales[:, 0] = 0.5
    inputs = (means, quats, scales, opacities * (0.05 if faint else 1.0), colors)
    image = reference(splats_of(*inputs), camera()).image
    drawn = cpu_raster.rasterize(splats_of(*(value.float() for value in inputs)), camera(torch.float32)).image
    away = safe_pixels((*inputs, torch.zeros(400, 2))).bool()
    assert away.float().mean() > 0.3
    assert image[away].max() > (0.02 if faint else 0.5)
    # Conics of needles are large, and so are their roundings.
    assert (drawn - image).abs()[away].max() < 1e-3


@needs_native
def test_repeated_runs_and_thread_counts_give_the_same_bits(isa: int) -> None:
    inputs = tuple(v.float() for v in gaussians(2000))

    def results() -> list[Tensor]:
        image, alpha, gradients, radii = run(cpu_raster.rasterize, inputs, away=torch.ones(HEIGHT, WIDTH))
        return [image, alpha, *gradients, radii]

    check_any_threads(results, (1, 2, 2, 3))


def check_nothing_broken_or_hidden_is_drawn(rasterize) -> None:
    empty = tuple(v[:0].float() for v in gaussians())
    image, alpha, gradients, radii = run(rasterize, empty, background=COLOURED)
    assert torch.equal(image, COLOURED.expand(HEIGHT, WIDTH, 3))
    assert not alpha.any()
    assert [len(of) for of in (radii, *gradients)] == [0] * 7
    inputs = [v[:7].float().clone() for v in gaussians()]
    inputs[0][0] = torch.nan
    inputs[0][1] = torch.tensor([0.0, 0.0, -5.0])
    inputs[1][2] = torch.inf
    inputs[2][3] = torch.tensor([1e9, 1e9, 1e9])
    inputs[4][4, 1] = torch.nan
    image, _, gradients, radii = run(rasterize, tuple(inputs))
    assert radii[:5].tolist() == [0.0] * 5
    assert torch.isfinite(image).all()
    assert all(torch.isfinite(gradient).all() and not gradient[:5].any() for gradient in gradients)


@needs_native
def test_nothing_broken_or_hidden_is_drawn(isa: int) -> None:
    check_nothing_broken_or_hidden_is_drawn(cpu_raster.rasterize)


@needs_native
def test_a_gaussian_larger_than_the_picture(isa: int) -> None:
    inputs = [v[:1].float().clone() for v in gaussians()]
    inputs[0][:] = torch.tensor([[0.0, 0.0, 2.0]])
    inputs[2][:] = 50.0
    image, _, gradients, _ = run(cpu_raster.rasterize, tuple(inputs))
    truth, _, truth_gradients, _ = run(reference, tuple(v.double() for v in inputs))
    assert (image - truth).abs().max() < 1e-5
    assert torch.allclose(gradients[4].double(), truth_gradients[4], rtol=1e-4)


def check_that_memory_is_freed_without_a_backward_pass(rasterize) -> None:
    inputs = tuple(v.float().requires_grad_() for v in gaussians(3000)[:5])
    view = camera(torch.float32)._replace(width=320, height=240)
    peaks = []
    for _ in range(3):
        for _ in range(40):
            rasterize(splats_of(*inputs), view)
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    assert peaks[2] - peaks[0] < 20_000  # kB; 80 pictures that leaked would hold more than 40,000


@needs_native
def test_memory_is_freed_without_a_backward_pass() -> None:
    check_that_memory_is_freed_without_a_backward_pass(cpu_raster.rasterize)


def test_another_precision_is_refused_with_a_way_out() -> None:
    with pytest.raises(BackendError, match="reference back-end"):
        cpu_raster.rasterize(splats_of(*gaussians(3)[:5]), camera())


def some_tiles() -> TileSelection:
    mask = torch.zeros(tile_grid(WIDTH, HEIGHT), dtype=torch.bool)
    mask[0, 1] = mask[2, 2] = mask[2, 3] = mask[3, 4] = True
    return TileSelection(mask, WIDTH, HEIGHT)


def run_tiles(
    rasterize, inputs: tuple[Tensor, ...], tiles: TileSelection | None, onto: Tensor | None, trained: int | None
):
    dtype = inputs[0].dtype
    leaves = [value.clone().requires_grad_() for value in inputs]
    output = rasterize(
        splats_of(*leaves[:5]), camera(dtype), screen_offsets=leaves[5], tiles=tiles, onto=onto, trained=trained
    )
    g = torch.Generator().manual_seed(11)
    v_image = torch.randn(HEIGHT, WIDTH, 3, generator=g, dtype=torch.float64) * usual_safe_pixels()[..., None]
    gradients = torch.autograd.grad((output.image * v_image.to(dtype)).sum(), leaves)
    return output, gradients


@needs_native
@pytest.mark.parametrize("trained", [None, 120])
def test_tiles_draw_and_learn_as_the_whole_picture_does_there(isa: int, trained: int | None) -> None:
    inputs = gaussians()
    single = tuple(value.float() for value in inputs)
    tiles = some_tiles()
    inside = tiles.pixels()
    onto = torch.rand(HEIGHT, WIDTH, 3)
    exact, exact_gradients = run_tiles(reference, inputs, tiles, onto.double(), trained)
    whole, _ = run_tiles(cpu_raster.rasterize, single, None, None, None)
    memory = onto.clone()
    output, gradients = run_tiles(cpu_raster.rasterize, single, tiles, memory, trained)
    assert torch.equal(output.image[inside], whole.image[inside])
    assert torch.equal(output.image[~inside], onto[~inside])
    assert output.image.data_ptr() == memory.data_ptr()
    assert not memory.requires_grad
    assert not output.alpha[~inside].any()
    assert torch.equal(output.alpha[inside], whole.alpha[inside])
    assert torch.equal(output.radii > 0, exact.radii > 0)
    assert 0 < (output.radii > 0).sum() < (whole.radii > 0).sum()
    for name, ours, theirs in zip(NAMES, gradients, exact_gradients, strict=True):
        assert (ours - theirs).norm() < 1e-4 * theirs.norm(), name
        if trained is not None:
            assert not ours[trained:].any(), name
            assert not theirs[trained:].any(), name


@needs_native
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 8, 9])
def test_blending_weights(isa: int, channels: int) -> None:
    inputs = gaussians()
    maps = torch.rand(HEIGHT, WIDTH, channels, dtype=torch.float64) * usual_safe_pixels()[..., None]
    exact = reference_raster.blending_weights(splats_of(*inputs[:5]), camera(), maps)
    single = splats_of(*(value.float() for value in inputs[:5])), camera(torch.float32), maps.float()
    ours = cpu_raster.blending_weights(*single)
    assert ours.shape == exact.shape == (len(inputs[0]), channels)
    # Float32 sums of some hundreds of terms of size one: 1e-5 is 80 units in the last place.
    assert ((ours - exact).norm(dim=0) < 1e-5 * exact.norm(dim=0)).all()
    again = reference_raster.weights_by_gradient(cpu_raster.rasterize, *single)
    assert ((ours - again).norm(dim=0) < 1e-5 * exact.norm(dim=0)).all()


@needs_native
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 8, 9])
def test_blending_weights_do_not_depend_on_threads(isa: int, channels: int) -> None:
    splats = splats_of(*(value.float() for value in gaussians(2000)[:5]))
    maps = torch.rand(HEIGHT, WIDTH, channels, generator=torch.Generator().manual_seed(3))
    assert cpu_raster.blending_weights(splats, camera(torch.float32), maps).any()
    check_any_threads(lambda: [cpu_raster.blending_weights(splats, camera(torch.float32), maps)], (1, 2, 2))


@needs_native
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 6, 7, 8, 9])
@pytest.mark.parametrize("background", [None, torch.tensor([0.2, 0.5, 0.9])])
def test_a_picture_with_weights_is_both(isa: int, channels: int, background: Tensor | None) -> None:
    splats = splats_of(*(value.float() for value in gaussians(2000)[:5]))
    maps = torch.rand(HEIGHT, WIDTH, channels, generator=torch.Generator().manual_seed(3))
    picture, weights = cpu_raster.picture_and_weights(splats, camera(torch.float32), maps, background=background)
    drawn = cpu_raster.rasterize(splats, camera(torch.float32), background=background)
    assert torch.equal(picture, drawn.image)
    assert torch.equal(weights, cpu_raster.blending_weights(splats, camera(torch.float32), maps))


@needs_native
@pytest.mark.parametrize("intervals", [None, torch.full((300,), 0.02)])
def test_radii_are_those_of_a_drawing(isa: int, intervals: Tensor | None) -> None:
    splats = replace(splats_of(*(value.float() for value in gaussians()[:5])), sampling_intervals=intervals)
    for module in (cpu_raster, reference_raster):
        radii = module.projected_radii(splats, camera(torch.float32))
        assert 0 < (radii > 0).sum() < 300
        assert torch.equal(radii, module.rasterize(splats, camera(torch.float32)).radii)


@needs_native
@pytest.mark.parametrize("channels", [1, 3, 8, 9])
def test_what_maps_leave_out_changes_no_weight(isa: int, channels: int) -> None:
    """Blocks and tiles in which all maps are zero are passed over; with the picture they are not."""
    splats = splats_of(*(value.float() for value in gaussians(2000)[:5]))
    generator = torch.Generator().manual_seed(4)
    maps = torch.zeros(HEIGHT, WIDTH, channels)
    maps[17:20, 30:50] = torch.rand(3, 20, channels, generator=generator)
    maps[40, 3] = 1.0
    sparse = cpu_raster.blending_weights(splats, camera(torch.float32), maps)
    _, everywhere = cpu_raster.picture_and_weights(splats, camera(torch.float32), maps)
    assert 0 < (sparse[:, 0] > 0).sum() < 400, "most Gaussians reach no such pixel"
    assert torch.equal(sparse, everywhere)
    assert not cpu_raster.blending_weights(splats, camera(torch.float32), torch.zeros_like(maps)).any()


@needs_native
def test_blending_weights_of_nothing(isa: int) -> None:
    nothing = splats_of(*(value[:0].float() for value in gaussians()[:5]))
    maps = torch.ones(HEIGHT, WIDTH, 5)
    weights = cpu_raster.blending_weights(nothing, camera(torch.float32), maps)
    assert weights.shape == (0, 5)
