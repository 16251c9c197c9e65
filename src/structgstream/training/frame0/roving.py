# SPDX-License-Identifier: Apache-2.0
"""Pictures of a roving camera in the iterations of frame 0.

Where people are in frame 0 is masked beforehand (``data/roving.py``). A phone exposes each frame anew, and a view is
visited too seldom for a gain to be learned by small steps. So the gains of a roving picture are those that fit its last
rendering best, and are no parameters.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import torch
from torch import Tensor

from structgstream.frames import RovingPicture
from structgstream.scene.color import CameraColor
from structgstream.scene.render import Rendering
from structgstream.scene.scene import Scene
from structgstream.training.frame0.regularizers import COVERED
from structgstream.training.views import View, blackened, coarse_to_fine

COLORS_FROM = 0.05  # share of the iterations after which gains follow the renderings
MAX_GAIN = 2.0
MIN_COUNTING = 0.05  # share of a picture's pixels that gains need


@dataclass
class RovingViews:
    """The roving pictures as views; their indices follow those of the training cameras.

    Args:
        first: number of training cameras.
        fits_gains: whether gains are fitted.
        gains: ``[R, 3]``.
    """

    views: list[View]
    first: int
    fits_gains: bool
    gains: Tensor

    @classmethod
    def of(
        cls, pictures: Sequence[RovingPicture], *, first: int, fits_gains: bool, device: torch.device
    ) -> "RovingViews":
        """The views of ``pictures``, whose cameras are in normalised units."""
        views = []
        for number, picture in enumerate(pictures):
            mask = torch.from_numpy(picture.mask).to(device)
            image = blackened(torch.from_numpy(picture.image).to(device), mask)
            views.append(View(first + number, picture.camera, image, mask))
        return cls(views, first, fits_gains, torch.ones(len(views), 3, device=device))

    def has(self, view: View) -> bool:
        """Whether ``view`` is one of these, whatever its size."""
        return view.index >= self.first

    def applied(self, scene: Scene, view: View) -> tuple[Scene, View]:
        """``scene`` with a colour for ``view``, and ``view`` with its row in it."""
        number, color = view.index - self.first, scene.camera_color
        gains = self.gains[number : number + 1]
        own = CameraColor(torch.cat([color.gains, gains]), torch.cat([color.biases, torch.zeros_like(gains)]))
        return replace(scene, camera_color=own), replace(view, index=len(color.gains))

    def fit_gains(self, view: View, rendering: Rendering, *, share: float) -> None:
        """The gains of ``view`` by least squares to its rendering, at this share of the iterations."""
        if not self.fits_gains or share < COLORS_FROM:
            return
        assert view.mask is not None, "of each"
        with torch.no_grad():
            image = rendering.image.detach()
            counts = (view.mask & (rendering.alpha.detach() > COVERED)).float()
            weighed = image * counts[..., None]
            found = (weighed * view.colors).sum((0, 1)) / (weighed * image).sum((0, 1)).clamp(min=1e-6)
            if float(counts.mean()) > MIN_COUNTING:
                self.gains[view.index - self.first] = found.clamp(1 / MAX_GAIN, MAX_GAIN)


def alternating(
    views: list[View], roving: list[View], stages: Sequence[tuple[int, float]], *, generator: torch.Generator
) -> Iterator[View]:
    """Endless shuffled views, by turns of the training cameras and of the roving one; ``stages`` as of
    :func:`coarse_to_fine`."""
    halves = [(-(-count // 2), scale) for count, scale in stages]
    both = (coarse_to_fine(own, halves, generator=generator) for own in (views, roving))
    return chain.from_iterable(zip(*both, strict=True))
