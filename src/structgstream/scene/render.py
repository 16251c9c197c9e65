# SPDX-License-Identifier: Apache-2.0
"""Rendering: from a scene and a camera to a picture."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.environment import in_environment
from structgstream.gaussians import Gaussians, concatenate
from structgstream.kernels.backend import Backend, on_processor
from structgstream.kernels.reference_raster import as_picture
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.scene import Scene


@dataclass(frozen=True)
class Rendering:
    """The result of one rendering.

    Args:
        image: ``[H, W, 3]`` sRGB, not clamped.
        alpha: ``[H, W]`` coverage.
        radii: ``[N]`` extent on the picture in pixels, 0 for Gaussians that were not drawn.
        gaussians: the drawn set, ``N`` rows.
        screen_offsets: ``[N, 2]`` zeros; after ``backward`` its gradient is the view-space positional gradient in
            pixels (None when it is not tracked).
    """

    image: Tensor
    alpha: Tensor
    radii: Tensor
    gaussians: Gaussians
    screen_offsets: Tensor | None

    def detached(self) -> "Rendering":
        """The same rendering without a gradient graph."""
        return Rendering(self.image.detach(), self.alpha.detach(), self.radii, self.gaussians.detached(), None)


def draw(
    gaussians: Gaussians,
    camera: Camera,
    backend: Backend,
    *,
    track_screen: bool = False,
    active: ActiveTiles | None = None,
    background: Tensor | None = None,
) -> Rendering:
    """Rasterise a set of Gaussians.

    Args:
        gaussians: the drawable set, in the units of the camera.
        camera: the view.
        backend: the compute back-end.
        track_screen: compute the view-space positional gradient (see :class:`Rendering`).
        active: draw only its tiles, into its picture and together with its static Gaussians. ``radii``, ``gaussians``
            and ``screen_offsets`` of the result cover only ``gaussians``.
        background: ``[3]`` background colour; None for black.
    """
    count, viewport = len(gaussians), camera.viewport(gaussians.means)
    offsets = torch.zeros_like(gaussians.means[:, :2], requires_grad=True) if track_screen else None
    if active is None:
        output = backend.rasterize(gaussians, viewport, background=background, screen_offsets=offsets)
    else:
        static = active.static
        output = backend.rasterize(
            concatenate(gaussians, static),
            viewport,
            background=background,
            screen_offsets=None if offsets is None else torch.cat([offsets, offsets.new_zeros(len(static), 2)]),
            tiles=active.tiles,
            onto=active.picture,
            trained=count,
        )
    return Rendering(output.image, output.alpha, output.radii[:count], gaussians, offsets)


class Drawable(Protocol):
    """A model that generates Gaussians for a camera: a ``Scene``, or another method's model."""

    def gaussians(self, camera: Camera, backend: Backend) -> Gaussians: ...


def render(scene: Drawable, camera: Camera, backend: Backend) -> Rendering:
    """Draw ``scene`` for ``camera`` (in the scene's units), without gradient.

    The colour correction is the mean one, the identity. The background is the scene's environment, if it has one.
    """
    with torch.no_grad():
        rendering, environment = _on_black(scene, camera, backend), _environment(scene)
        if environment is None:
            return rendering
        return replace(rendering, image=in_environment(rendering.image, rendering.alpha, camera, environment))


def render_picture(scene: Drawable, camera: Camera, backend: Backend) -> NDArray[np.uint8]:
    """:func:`render` as the displayed picture ``[H, W, 3]``."""
    with torch.no_grad():
        rendering = _on_black(scene, camera, backend)
        picture = backend.display(rendering.image, rendering.alpha, camera, _environment(scene))
    return on_processor(picture)[0].numpy()


def _on_black(scene: Drawable, camera: Camera, backend: Backend) -> Rendering:
    if not isinstance(scene, Scene):
        return draw(scene.gaussians(camera, backend), camera, backend)
    (gaussians,) = scene.gaussians_of_views([camera], backend)  # a GPU generates them without being waited for
    return draw(gaussians, camera, backend)


def _environment(scene: Drawable) -> Tensor | None:
    return scene.environment if isinstance(scene, Scene) else None


def to_8bit_image(image: Tensor) -> NDArray[np.uint8]:
    """:func:`as_picture` as an array."""
    return as_picture(image).cpu().numpy()
