# SPDX-License-Identifier: Apache-2.0
"""A scene at one time step, independent of losses, files and optimisers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.environment import environment
from structgstream.gaussians import Gaussians, concatenate
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import Anchors, MLPWeights, StructuredGaussians, TileSelection
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.sampling import RigSampling


@dataclass(frozen=True)
class Scene:
    """Anchors, the three MLPs that generate structured Gaussians, free Gaussians, and the rig's colour correction.

    Args:
        anchors: the structured part.
        mlps: F_alpha, F_c and F_Sigma.
        free: the free part.
        camera_color: one row per training camera of the rig, in rig order.
        distance_input: whether the distance to the camera is an input of the MLPs (paper: yes; Scaffold-GS: no).
        appearance_basis: ``[R, D]`` directions along which the anchors' features change after frame 0; None without
            ``appearance``.
        environment: ``[(degree + 1)^2, 3]`` background coefficients (``environment.py``); None for black.
        sampling: sampling by the training cameras, which sets the low-pass of Gaussians (``scene/sampling.py``); None:
            the low-pass is that of the drawn picture.
        anchor_intervals: ``[M]`` sampling intervals that stay constant during iterations, because anchors move by far
            less than their depth; None: computed from the positions.
    """

    anchors: AnchorCloud
    mlps: MLPWeights
    free: FreeGaussians
    camera_color: CameraColor
    distance_input: bool = True
    appearance_basis: Tensor | None = None
    environment: Tensor | None = None
    sampling: RigSampling | None = None
    anchor_intervals: Tensor | None = None

    @property
    def features(self) -> Tensor:
        """The features ``[M, D]`` that the MLPs read: f_v plus the change of appearance."""
        anchors = self.anchors
        if anchors.appearance is None or self.appearance_basis is None:
            return anchors.features
        return anchors.features + anchors.appearance @ self.appearance_basis

    def with_folded_appearance(self) -> "Scene":
        """An equivalent scene with the appearance folded into the features: faster when it is rendered repeatedly."""
        if self.appearance_basis is None:
            return self
        anchors = replace(self.anchors, features=self.features, appearance=None)
        return replace(self, anchors=anchors, appearance_basis=None)

    def background(self, camera: Camera) -> Tensor | None:
        """The environment's colour ``[3]`` along ``camera``'s axis; None for black."""
        colors = self.backgrounds([camera])
        return None if colors is None else colors[0]

    def backgrounds(self, cameras: Sequence[Camera]) -> Tensor | None:
        """The environment's colour ``[V, 3]`` along the axis of each of ``cameras``; None for black.

        Used in training: a constant background costs nothing in the rasteriser, and is accurate enough because little
        of it is visible.
        """
        if self.environment is None:
            return None
        axes = torch.stack([camera.viewport(self.environment).viewmat[2, :3] for camera in cameras])
        # Contiguous: a product of transposed tensors rounds by the number of its rows.
        return environment(self.environment.contiguous(), axes)

    def structured(
        self, camera: Camera, backend: Backend, *, tiles: TileSelection | None = None
    ) -> StructuredGaussians:
        """The structured Gaussians of the anchors in ``camera``'s view, or of those that reach ``tiles``."""
        cloud, intervals = self.anchors, self._intervals_of_anchors()
        generated = backend.generate_structured(
            self._anchors_to_generate(),
            self.mlps,
            camera.viewport(cloud.positions),
            distance_input=self.distance_input,
            tiles=tiles,
            sampling_intervals=intervals,
        )
        if intervals is None:
            return generated
        of_slots = intervals.repeat_interleave(cloud.offsets_per_anchor)
        drawn = of_slots.index_select(0, generated.gaussians.ids)  # a quarter of the time of of_slots[ids]
        return replace(generated, gaussians=replace(generated.gaussians, sampling_intervals=drawn))

    def gaussians_of_views(
        self, cameras: Sequence[Camera], backend: Backend, *, tiles: Sequence[TileSelection] | None = None
    ) -> list[Gaussians]:
        """:meth:`gaussians` of each of ``cameras``, whose pictures have one size, without graph; structured ones of
        anchors that reach ``tiles``."""
        with torch.no_grad():
            return backend.generate_views(
                self._anchors_to_generate(),
                self.mlps,
                [camera.viewport(self.anchors.positions) for camera in cameras],
                free=self.free_gaussians(),
                distance_input=self.distance_input,
                tiles=tiles,
                sampling_intervals=self._intervals_of_anchors(),
            )

    def _anchors_to_generate(self) -> Anchors:
        cloud = self.anchors
        return Anchors(cloud.positions, cloud.log_offset_scales, cloud.log_base_scales, cloud.offsets, self.features)

    def _intervals_of_anchors(self) -> Tensor | None:
        if self.anchor_intervals is None and self.sampling is not None:
            return self.sampling.intervals(self.anchors.positions)
        return self.anchor_intervals

    def free_gaussians(self) -> Gaussians:
        """The free Gaussians after activation, with their ids (Note [Ids])."""
        free = self.free
        first = self.anchors.offsets.shape[0] * self.anchors.offsets_per_anchor
        return Gaussians(
            means=free.means,
            quats=free.quats,
            scales=free.log_scales.contiguous().exp(),  # exp of strided columns takes four times as long
            opacities=free.logit_opacities.sigmoid(),
            colors=free.colors,
            ids=torch.arange(first, first + len(free), device=free.means.device),
            sampling_intervals=None if self.sampling is None else self.sampling.intervals(free.means),
        )

    def gaussians(self, camera: Camera, backend: Backend) -> Gaussians:
        """The Gaussians to draw for ``camera``: structured ones in view, then all free ones."""
        return self.with_free_gaussians(self.structured(camera, backend))

    def with_free_gaussians(self, generated: StructuredGaussians) -> Gaussians:
        """``generated`` and the free Gaussians as one drawable set."""
        structured = generated.gaussians
        return concatenate(structured, self.free_gaussians()) if len(self.free) else structured

    def without_free(self) -> "Scene":
        """The same scene with no free Gaussians."""
        return replace(self, free=FreeGaussians.empty(self.anchors.positions))
