# SPDX-License-Identifier: Apache-2.0
"""The peers by name, and the method that decodes a file."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from structgstream.codec.container.byte_source import FileBytes
from structgstream.codec.packets import StreamHeader
from structgstream.errors import StreamError
from structgstream.session.presets import TINY
from structgstream_studies.peers.additions import AdditionsConfig
from structgstream_studies.peers.container import PeerReader
from structgstream_studies.peers.densify import DensifyConfig
from structgstream_studies.peers.gaussians import GaussiansConfig
from structgstream_studies.peers.hash_grid import GridConfig
from structgstream_studies.peers.method import PeerMethod
from structgstream_studies.peers.scaffold import SCAFFOLD, ScaffoldGS
from structgstream_studies.peers.threedgs import ThreeDGS
from structgstream_studies.peers.threedgstream import ThreeDGStream, ThreeDGStreamConfig
from structgstream_studies.peers.warm_up import WarmUpConfig

AnyMethod = PeerMethod[Any, Any]
MAX_LEVELS, MAX_LOG2_ROWS, MAX_WIDTH = 32, 24, 1024

METHODS: Mapping[str, AnyMethod] = {method.name: method for method in (ScaffoldGS(), ThreeDGS(), ThreeDGStream())}
"""Every peer with the configuration that comparisons use."""

_TINY_GAUSSIANS = GaussiansConfig(
    iterations=60,
    coarse_iterations=30,
    sh_from=20,
    densify=DensifyConfig(start=10, stop=50, interval=20, reset_at=None),
)

TINY_METHODS: Mapping[str, AnyMethod] = {
    method.name: method
    for method in (
        ScaffoldGS(
            replace(
                TINY.initial,
                sampling_filter=False,
                distance_input=SCAFFOLD.distance_input,
                losses=SCAFFOLD.losses,
            )
        ),
        ThreeDGS(_TINY_GAUSSIANS),
        ThreeDGStream(
            ThreeDGStreamConfig(
                initial=_TINY_GAUSSIANS,
                grid=GridConfig(levels=4, log2_rows=10, base=4, hidden=16),
                warm_up=WarmUpConfig(iterations=300, rate=2e-3, batch=128, batches=4),
                iterations=30,
                shift_scale=1.0,
                collect_from=20,
                additions=AdditionsConfig(iterations=10, interval=5),
            )
        ),
    )
}
"""Small configurations for tests; low quality."""


def decoder_of(header: StreamHeader) -> AnyMethod:
    """The method that reads a file with this header.

    Raises:
        StreamError: an unknown method, or a configuration that it cannot have.
    """
    if header.codec not in METHODS:
        raise StreamError(f"The file was written by {header.codec!r}; known are {', '.join(METHODS)}.")
    if header.codec != ThreeDGStream().name:
        return METHODS[header.codec]
    try:
        grid = GridConfig(**header.config["grid"])
        shift_scale = float(header.config["shift_scale"])
        sizes = (grid.levels, grid.features, grid.log2_rows, grid.base, grid.hidden)
        if not all(type(size) is int and size > 0 for size in sizes) or grid.outputs != 8 or not grid.growth >= 1.0:
            raise ValueError(f"a grid of {grid}")
        if grid.levels > MAX_LEVELS or grid.log2_rows > MAX_LOG2_ROWS or max(grid.hidden, grid.features) > MAX_WIDTH:
            raise ValueError(f"a grid of {grid}")
        if not grid.cells(grid.levels - 1) < 2**31:
            raise ValueError(f"{grid.cells(grid.levels - 1):g} cells along an axis")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise StreamError(f"The file's configuration does not fit {header.codec!r} ({error}).") from error
    return ThreeDGStream(ThreeDGStreamConfig(grid=grid, shift_scale=shift_scale))


def open_peer(path: Path | str) -> PeerReader[Any]:
    """Read a peer's file, which stays open as long as the reader is used.

    Raises:
        StreamError: there is no such file, or it is not a peer's.
    """
    return PeerReader(FileBytes(path), decoder_of, name=str(path))
