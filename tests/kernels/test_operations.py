# SPDX-License-Identifier: Apache-2.0
# pyright: reportUnnecessaryTypeIgnoreComment=true
"""Every back-end's functions have the signatures of ``kernels.operations``, and keep to its Note [Ownership]."""

import inspect
from collections.abc import Callable
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from rigs import arc_rig, random_scene
from structgstream.kernels import _nvcc, cuda, cuda_anchors, operations
from structgstream.kernels._load import native_reason
from structgstream.kernels.backend import Backend, cpu_backend, cuda_backend, nonblocking, reference_backend
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.cuda_tiles import PairBudget
from structgstream.kernels.prototypes import CUDA_PROTOTYPES
from structgstream.kernels.raster_types import TileSelection, tile_grid

PROTOCOLS = {
    "rasterize": operations.Rasterize,
    "blending_weights": operations.BlendingWeights,
    "picture_and_weights": operations.PictureAndWeights,
    "l1_ssim": operations.L1SSIM,
    "volume": operations.Volume,
    "excess": operations.Excess,
    "neighbour_difference": operations.NeighbourDifference,
    "change_bits": operations.ChangeBits,
    "changed_pixels": operations.ChangedPixels,
    "picture_residual": operations.PictureResidual,
    "confident_flow": operations.ConfidentFlow,
    "lift": operations.Lift,
    "sweep": operations.Sweep,
    "plane_scores": operations.PlaneScores,
    "generate_structured": operations.GenerateStructured,
    "adam_step": operations.AdamStep,
}


native = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))
BUILDERS = [
    pytest.param(reference_backend, id="reference"),
    pytest.param(cpu_backend, id="cpu", marks=native),
]


def other_result(scales: Tensor, opacities: Tensor) -> Tensor:
    return (scales.prod(1) * opacities).sum()


def fewer_arguments(offsets: Tensor, log_scales: Tensor) -> Tensor:
    return (offsets * log_scales[:, None]).sum()


def other_names(offsets: Tensor, scales: Tensor, limit: float) -> Tensor:
    return (offsets * scales[:, None]).clamp(max=limit).sum()


def refused_by_the_type_checker(backend: Backend) -> None:
    """Never called. An ignore that is not needed is an error here: then the type checker let a function pass."""
    volume: operations.Volume = other_result  # pyright: ignore[reportAssignmentType]
    excess: operations.Excess = fewer_arguments  # pyright: ignore[reportAssignmentType]
    excess = other_names  # pyright: ignore[reportAssignmentType]
    rasterize: operations.Rasterize = backend.l1_ssim  # pyright: ignore[reportAssignmentType]
    Backend(
        name="mixed",
        device=backend.device,
        rasterize=rasterize,
        blending_weights=backend.rasterize,  # pyright: ignore[reportArgumentType]
        picture_and_weights=backend.picture_and_weights,
        l1_ssim=backend.l1_ssim,
        volume=volume,
        excess=excess,
        neighbour_difference=backend.neighbour_difference,
        change_bits=backend.change_bits,
        changed_pixels=backend.changed_pixels,
        picture_residual=backend.picture_residual,
        confident_flow=backend.confident_flow,
        lift=backend.lift,
        sweep=backend.sweep,
        plane_scores=backend.plane_scores,
        generate_structured=backend.generate_structured,
        adam_step=backend.adam_step,
    )


@pytest.fixture
def pretended_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    functions: Any = SimpleNamespace(**{name: SimpleNamespace() for name in CUDA_PROTOTYPES})
    library = KernelLibrary(functions, "cuda", lambda device: 0)
    monkeypatch.setattr(cuda, "cuda_reason", lambda: None)
    monkeypatch.setattr(_nvcc, "kernel_library", lambda: (library, "compiled"))


def cuda_without_waiting() -> Backend:
    return nonblocking(cuda_backend(), PairBudget.of(1, torch.device("cpu")))


@pytest.mark.usefixtures("pretended_gpu")
@pytest.mark.parametrize("build", [*BUILDERS, cuda_backend, cuda_without_waiting])
def test_signatures_are_the_protocols(build: Callable[[], Backend]) -> None:
    backend = build()
    assert {f.name for f in fields(backend)} == PROTOCOLS.keys() | {"name", "device", "recorder"}
    for name, protocol in PROTOCOLS.items():
        wanted = inspect.signature(protocol.__call__)
        found = inspect.signature(getattr(backend, name))
        own = list(wanted.parameters.values())[1:]  # without self
        shared = [found.parameters[parameter.name] for parameter in own]
        assert shared == own, name
        more = found.parameters.keys() - wanted.parameters.keys()
        assert all(found.parameters[extra].default is not inspect.Parameter.empty for extra in more), name
        assert found.return_annotation == wanted.return_annotation, name


@pytest.mark.parametrize("build", BUILDERS)
def test_a_picture_is_drawn_onto_in_its_own_memory_and_nothing_else_changes(build: Callable[[], Backend]) -> None:
    backend, camera = build(), arc_rig()["cam01"]
    mask = torch.zeros(tile_grid(camera.width, camera.height), dtype=torch.bool)
    mask[1, 1] = True
    tiles = TileSelection(mask, camera.width, camera.height)
    gaussians = random_scene(40).gaussians(camera, backend)
    colors = gaussians.colors.detach().clone().requires_grad_()
    given = replace(gaussians, colors=colors)
    before = {name: value.clone() for name, value in given.columns().items()}
    picture = torch.rand(camera.height, camera.width, 3)
    was, inside = picture.clone(), tiles.pixels()
    output = backend.rasterize(given, camera.viewport(gaussians.means), tiles=tiles, onto=picture)
    assert output.image.data_ptr() == picture.data_ptr()
    assert torch.equal(output.image, picture)
    assert torch.equal(picture[~inside], was[~inside])
    assert not torch.equal(picture[inside], was[inside])
    assert not picture.requires_grad
    assert output.image.requires_grad
    assert not output.radii.requires_grad
    (gradient,) = torch.autograd.grad(output.image.sum(), colors)
    assert gradient.any()
    assert all(torch.equal(getattr(given, name), value) for name, value in before.items())
    assert torch.equal(tiles.mask, mask)


@pytest.mark.parametrize("build", BUILDERS)
def test_a_picture_to_draw_onto_needs_tiles(build: Callable[[], Backend]) -> None:
    camera = arc_rig()["cam01"]
    gaussians = random_scene(5).gaussians(camera, reference_backend())
    with pytest.raises(AssertionError, match="needs tiles"):
        build().rasterize(gaussians, camera.viewport(gaussians.means), onto=torch.rand(32, 48, 3))


@pytest.mark.parametrize("build", [*BUILDERS, pytest.param(None, id="nonblocking")])
def test_anchors_that_were_looked_at_are_ascending_indices(build: Callable[[], Backend] | None) -> None:
    backend = replace(reference_backend(), generate_structured=cuda_anchors.generate_structured)
    backend = backend if build is None else build()
    scene, camera = random_scene(300, seed=3), next(iter(arc_rig(radius=0.6).cameras.values()))
    found = scene.structured(camera, backend)
    assert found.anchors.dtype == found.gaussians.ids.dtype == torch.int64
    assert (found.anchors.diff() > 0).all()
    assert (found.gaussians.ids.diff() > 0).all()
    assert found.raw_opacities.shape == (len(found.anchors), scene.anchors.offsets_per_anchor)
    seen = scene.structured(camera, reference_backend())
    assert torch.isin(seen.anchors, found.anchors).all()
    drawn = found.gaussians.opacities > 0
    assert torch.equal(found.gaussians.ids[drawn], seen.gaussians.ids)
    assert not found.gaussians.scales[~drawn].any()


@pytest.mark.parametrize("build", BUILDERS)
def test_a_step_of_adam_leaves_the_gradient(build: Callable[[], Backend]) -> None:
    param, gradient, first, second = torch.rand(4, 3), torch.rand(4, 3), torch.zeros(4, 3), torch.zeros(4, 3)
    was, kept = param.clone(), gradient.clone()
    build().adam_step(param, gradient, first, second, lr=0.1, step=1, betas=(0.9, 0.999), eps=1e-8)
    assert torch.equal(gradient, kept)
    assert (param < was).all()
    assert first.all()
    assert second.all()


@pytest.mark.parametrize("build", BUILDERS)
def test_weights_of_blending_have_no_graph(build: Callable[[], Backend]) -> None:
    camera = arc_rig()["cam01"]
    gaussians = random_scene(20).gaussians(camera, reference_backend())
    gaussians = replace(gaussians, means=gaussians.means.detach().requires_grad_())
    maps = torch.ones(camera.height, camera.width, 2)
    weights = build().blending_weights(gaussians, camera.viewport(gaussians.means), maps)
    assert weights.shape == (len(gaussians), 2)
    assert not weights.requires_grad
    picture, again = build().picture_and_weights(gaussians, camera.viewport(gaussians.means), maps)
    assert picture.shape == (camera.height, camera.width, 3)
    assert not picture.requires_grad
    torch.testing.assert_close(again, weights)
