# SPDX-License-Identifier: Apache-2.0
"""Every frame from scratch with plain Gaussians: 3DGS, and its float32 parameters as a file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.training.result import StepListener
from structgstream_studies.peers.gaussians import GaussiansConfig, fit_gaussians
from structgstream_studies.peers.method import Arrays, PeerFit, PointsMaker
from structgstream_studies.peers.plain import PlainGaussians
from structgstream_studies.peers.plain_arrays import gaussians_of, with_prefix


@dataclass(frozen=True)
class ThreeDGS:
    """The method behind the loop. No frame knows of another, and nothing is remembered."""

    config: GaussiansConfig = field(default_factory=GaussiansConfig)
    name: str = "3dgs"
    stands_alone: bool = True

    def first(
        self,
        frame: MultiViewFrame,
        rig: CameraRig,
        points: PointsMaker,
        *,
        backend: Backend,
        seed: int,
        on_step: StepListener | None = None,
    ) -> PeerFit[PlainGaussians]:
        """Any frame: see ``peers.gaussians.fit_gaussians``."""
        fit = fit_gaussians(frame, rig, points(), config=self.config, backend=backend, seed=seed, on_step=on_step)
        return PeerFit(fit.gaussians, fit.train_psnr, fit.seconds, fit.spawned, fit.pruned)

    def prepared(self, state: PlainGaussians, *, backend: Backend, seed: int) -> None:
        """Nothing."""

    def next(
        self,
        state: PlainGaussians,
        memory: None,
        frame: MultiViewFrame,
        rig: CameraRig,
        points: PointsMaker,
        *,
        backend: Backend,
        seed: int,
        on_step: StepListener | None = None,
    ) -> PeerFit[PlainGaussians]:
        """As :meth:`first`."""
        return self.first(frame, rig, points, backend=backend, seed=seed, on_step=on_step)

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
