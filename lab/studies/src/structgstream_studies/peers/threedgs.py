# SPDX-License-Identifier: Apache-2.0
"""Every frame from scratch with plain Gaussians: 3DGS, and its float32 parameters as a file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from numpy.typing import NDArray

from structgstream.session.pipeline import FrameTask
from structgstream.training.result import FitResult
from structgstream_studies.peers.gaussians import GaussiansConfig, fit_gaussians
from structgstream_studies.peers.method import Arrays, IndependentFrames
from structgstream_studies.peers.plain import PlainGaussians
from structgstream_studies.peers.plain_arrays import gaussians_of, with_prefix


@dataclass(frozen=True)
class ThreeDGS(IndependentFrames[PlainGaussians]):
    """The method behind the loop. No frame knows of another, and nothing is remembered."""

    config: GaussiansConfig = field(default_factory=GaussiansConfig)
    name: str = "3dgs"

    def first(self, task: FrameTask) -> FitResult[PlainGaussians]:
        """Any frame: see ``peers.gaussians.fit_gaussians``."""
        fit = fit_gaussians(
            task.frame,
            task.rig,
            task.points(),
            config=self.config,
            backend=task.backend,
            seed=task.seed,
            on_step=task.on_step,
        )
        return FitResult(**{**vars(fit), "scene": fit.scene.gaussians})

    def arrays(self, state: PlainGaussians) -> Arrays:
        """Every parameter in float32, as the published code stores it."""
        return with_prefix("gaussians", state)

    def restored(
        self, arrays: Mapping[str, NDArray[Any]], previous: PlainGaussians | None, *, device: torch.device
    ) -> PlainGaussians:
        """The decoder.

        Raises:
            StreamError: the arrays are not those of this method.
        """
        return gaussians_of(arrays, "gaussians", device)
