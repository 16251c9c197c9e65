# SPDX-License-Identifier: Apache-2.0
"""LPIPS (Zhang et al., 2018), version 0.1: distance of two pictures in the features of a classification network.

The trunks are implemented in plain torch. The published heads are part of the package (``lpips_heads.npz``, with their
licence). The trunks' weights are too large for that and must be installed (Note [Weights]); without them LPIPS is not
available.

Note [Weights]
~~~~~~~~~~~~~~
A trunk's weights are a torch file with torchvision's names of layers (``features.0.weight``). It is searched in this
order: the given path; the environment variable ``STRUCTGSTREAM_LPIPS_WEIGHTS``; torch's hub cache, where torchvision
stores it. A path may be a folder or one trunk's file. If a file name ends with eight digits of its SHA-256, as
torchvision's do, they are verified.
"""

import hashlib
import os
import pickle
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from structgstream.errors import ConfigError

ENVIRONMENT = "STRUCTGSTREAM_LPIPS_WEIGHTS"
MEAN = (-0.030, -0.088, -0.188)  # of pictures in [-1, 1], by channel
DEVIATION = (0.458, 0.448, 0.450)
EPSILON = 1e-10  # added to a feature vector's length

Features = tuple[Tensor, ...]
"""Features of one picture: ``[C, h, w]`` for each of five layers, each pixel's vector of length 1 (or 0)."""


@dataclass(frozen=True)
class Layer:
    """A convolution with ReLU, after a ``pool`` (size, stride) if any. LPIPS compares its output if ``tap`` is True."""

    index: int
    shape: tuple[int, int, int]  # channels out, channels in, kernel size
    stride: int
    padding: int
    pool: tuple[int, int] | None
    tap: bool


@dataclass(frozen=True)
class Trunk:
    """A network up to its last tap. ``pattern`` and ``file`` name its weights; ``smallest`` is the side it needs."""

    name: str
    title: str
    file: str
    pattern: str
    smallest: int
    layers: tuple[Layer, ...]


ALEX = Trunk(
    "alex",
    "AlexNet",
    "alexnet-owt-7be5be79.pth",
    "alexnet*.pth",
    31,
    (
        Layer(0, (64, 3, 11), 4, 2, None, True),
        Layer(3, (192, 64, 5), 1, 2, (3, 2), True),
        Layer(6, (384, 192, 3), 1, 1, (3, 2), True),
        Layer(8, (256, 384, 3), 1, 1, None, True),
        Layer(10, (256, 256, 3), 1, 1, None, True),
    ),
)


def _vgg_layers() -> tuple[Layer, ...]:
    layers, index, before = [], 0, 3
    for block, (width, depth) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        index += block > 0  # the pooling between blocks has a number of its own
        for i in range(depth):
            pool = (2, 2) if block and not i else None
            layers.append(Layer(index, (width, before, 3), 1, 1, pool, i == depth - 1))
            before, index = width, index + 2
    return tuple(layers)


VGG = Trunk("vgg", "VGG16", "vgg16-397923af.pth", "vgg16-*.pth", 16, _vgg_layers())
TRUNKS = (ALEX, VGG)


@dataclass(frozen=True)
class Lpips:
    """A trunk with its weights and heads on one device."""

    trunk: Trunk  # the network
    weights: tuple[tuple[Tensor, Tensor], ...]  # kernel and bias of each of the trunk's layers
    heads: tuple[Tensor, ...]  # for each tap the weight [C] of each channel's squared difference

    def features(self, picture: NDArray[np.uint8]) -> Features:
        """The unit features of an 8-bit sRGB picture ``[H, W, 3]``, with sides of at least ``trunk.smallest``."""
        device = self.heads[0].device
        with torch.no_grad():
            x = torch.from_numpy(np.ascontiguousarray(picture)).to(device).permute(2, 0, 1)[None] / 127.5 - 1.0
            mean, deviation = (x.new_tensor(values)[:, None, None] for values in (MEAN, DEVIATION))
            x = (x - mean) / deviation
            taps = []
            for layer, (kernel, bias) in zip(self.trunk.layers, self.weights, strict=True):
                if layer.pool is not None:
                    x = max_pool2d(x, *layer.pool)
                x = conv2d(x, kernel, bias, layer.stride, layer.padding).relu_()
                if layer.tap:
                    taps.append((x / (x.square().sum(1, keepdim=True).sqrt() + EPSILON))[0])
        return tuple(taps)

    def distance(self, a: Features, b: Features) -> float:
        """LPIPS of two pictures: the weighted squared differences of their features, averaged over pixels and summed
        over layers."""
        total = 0.0
        for head, x, y in zip(self.heads, a, b, strict=True):
            total += float(head @ (x - y).square_().flatten(1).mean(1))
        return total


def published_heads(trunk: Trunk) -> tuple[Tensor, ...]:
    """The heads of version 0.1, one ``[C]`` for each tap."""
    with np.load(Path(__file__).with_name("lpips_heads.npz")) as stored:
        return tuple(torch.from_numpy(stored[f"{trunk.name}_{tap}"]) for tap in range(5))


def weights_file(trunk: Trunk, given: Path | None = None) -> Path | None:
    """The file with the trunk's weights (Note [Weights]), or None. Raises ConfigError if the given path, or the
    environment variable's, does not exist."""
    named = os.environ.get(ENVIRONMENT)
    for path, source in ((given, "the path given"), (Path(named) if named else None, ENVIRONMENT)):
        if path is None:
            continue
        if not path.exists():
            raise ConfigError(f"There is no {path}, where {source} has the weights of LPIPS; give a folder or a file.")
        if found := _in(path, trunk):
            return found
    return _in(Path(torch.hub.get_dir()) / "checkpoints", trunk)


def how_to_get(trunk: Trunk) -> str:
    """Instructions for installing the trunk's weights."""
    return (
        f"the weights of {trunk.title} were not found: download https://download.pytorch.org/models/{trunk.file} into "
        f"{Path(torch.hub.get_dir()) / 'checkpoints'}, or into a folder that --lpips-weights or {ENVIRONMENT} names"
    )


def load_lpips(trunk: Trunk, path: Path, device: torch.device) -> Lpips:
    """LPIPS with the trunk's weights from a file, and the published heads. Raises ConfigError if the file is damaged,
    is not a file of weights, or is of another network."""
    _check_digest(path)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, ValueError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(f"{path} cannot be read as weights of {trunk.title} ({reason[:120]}).") from None
    weights = []
    for layer in trunk.layers:
        out, into, size = layer.shape
        kernel = _tensor(state, f"features.{layer.index}.weight", (out, into, size, size), path, trunk)
        bias = _tensor(state, f"features.{layer.index}.bias", (out,), path, trunk)
        weights.append((kernel.to(device), bias.to(device)))
    return Lpips(trunk, tuple(weights), tuple(head.to(device) for head in published_heads(trunk)))


def _in(path: Path, trunk: Trunk) -> Path | None:
    if path.is_file():
        return path if path.match(trunk.pattern) else None
    exact = path / trunk.file
    return exact if exact.exists() else next(iter(sorted(path.glob(trunk.pattern))), None)


def _check_digest(path: Path) -> None:
    wanted = re.search(r"-([0-9a-f]{8})\.pth$", path.name)
    if wanted is None:
        return
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if not digest.startswith(wanted[1]):
        raise ConfigError(f"{path} has the SHA-256 {digest[:8]}..., not the one of its name; download it again.")


def _tensor(state: object, name: str, shape: tuple[int, ...], path: Path, trunk: Trunk) -> Tensor:
    value = state.get(name) if isinstance(state, Mapping) else None
    if not isinstance(value, Tensor) or tuple(value.shape) != shape:
        got = f"the shape {tuple(value.shape)}" if isinstance(value, Tensor) else "nothing"
        raise ConfigError(
            f"{path} contains no weights of {trunk.title}: {name} must have the shape {shape}, got {got}; "
            f"expected a state dict like torchvision's {trunk.file}."
        )
    return value.float()
