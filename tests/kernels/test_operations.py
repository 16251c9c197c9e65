# SPDX-License-Identifier: Apache-2.0
# pyright: reportUnnecessaryTypeIgnoreComment=true
"""Every back-end's functions have the signatures of the table, and keep to Note [Ownership] of ``kernels.backend``."""

import inspect
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from structgstream.kernels.backend import Backend, cuda_backend, reference_backend
from structgstream.kernels.values import TileSelection, tile_grid
from tests.support.backends import PROCESSOR, on_each_backend
from tests.support.rigs import arc_rig, random_scene


def refused_by_the_type_checker(backend: Backend, opacities: Tensor) -> None:
    """Never called. An ignore that is not needed is an error here: then the type checker let a call pass."""
    backend.volume(opacities)  # pyright: ignore[reportCallIssue]
    backend.volume(opacities, 1.0)  # pyright: ignore[reportArgumentType]
    backend.excess(opacities, opacities, bound=1.0)  # pyright: ignore[reportCallIssue]
    backend.lifted(opacities)  # pyright: ignore[reportAttributeAccessIssue]
    total: Tensor = backend.volume(opacities, opacities)  # pyright: ignore[reportAssignmentType]
    del total


@pytest.mark.usefixtures("pretended_gpu")
@pytest.mark.parametrize("build", [*PROCESSOR, cuda_backend])
def test_signatures_are_those_of_the_table(build: Callable[[], Backend]) -> None:
    backend = build()
    assert len(Backend.operations()) == 20
    for name, operation in Backend.operations().items():
        wanted = inspect.signature(operation.oracle)
        found = inspect.signature(getattr(backend, name))
        shared = [found.parameters[parameter] for parameter in wanted.parameters]
        assert shared == list(wanted.parameters.values()), name
        more = found.parameters.keys() - wanted.parameters.keys()
        assert all(found.parameters[extra].default is not inspect.Parameter.empty for extra in more), name
        assert found.return_annotation == wanted.return_annotation, name


def test_an_operation_that_the_table_lacks_or_a_back_end_lacks_is_refused() -> None:
    backend = reference_backend()
    with pytest.raises(AssertionError, match="lifted"):
        backend.with_functions(lifted=backend.lift)
    with pytest.raises(AssertionError, match="lift"):
        replace(backend, functions={name: run for name, run in backend.functions.items() if name != "lift"})


@on_each_backend
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


@on_each_backend
def test_a_picture_to_draw_onto_needs_tiles(build: Callable[[], Backend]) -> None:
    camera = arc_rig()["cam01"]
    gaussians = random_scene(5).gaussians(camera, reference_backend())
    with pytest.raises(AssertionError, match="needs tiles"):
        build().rasterize(gaussians, camera.viewport(gaussians.means), onto=torch.rand(32, 48, 3))


@on_each_backend
def test_anchors_that_were_looked_at_are_ascending_indices(build: Callable[[], Backend]) -> None:
    backend = build()
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


@on_each_backend
def test_a_step_of_adam_leaves_the_gradient(build: Callable[[], Backend]) -> None:
    param, gradient, first, second = torch.rand(4, 3), torch.rand(4, 3), torch.zeros(4, 3), torch.zeros(4, 3)
    was, kept = param.clone(), gradient.clone()
    build().adam_step(param, gradient, first, second, lr=0.1, step=1, betas=(0.9, 0.999), eps=1e-8)
    assert torch.equal(gradient, kept)
    assert (param < was).all()
    assert first.all()
    assert second.all()


@on_each_backend
def test_weights_of_blending_have_no_graph(build: Callable[[], Backend]) -> None:
    camera = arc_rig()["cam01"]
    gaussians = random_scene(20).gaussians(camera, reference_backend())
    gaussians = replace(gaussians, means=gaussians.means.detach().requires_grad_())
    maps = torch.ones(camera.height, camera.width, 2)
    views = [gaussians], [camera.viewport(gaussians.means)], maps[None]
    slots = int(gaussians.ids.max()) + 1
    (picture,), (weights,) = build().draw_and_weigh_views(*views, slots=slots)
    assert picture.shape == (camera.height, camera.width, 3)
    assert not picture.requires_grad
    assert weights.shape == (slots, 2)
    assert not weights.requires_grad
    assert torch.equal(build().weigh_views(*views, slots=slots)[0], weights)
