# SPDX-License-Identifier: Apache-2.0
"""Reads ``.sog`` files as the public description of the format, version 2, has it; pixel by pixel, with Pillow."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from structgstream.exporters.bake import BakedGaussians


def read_sog(path: Path) -> BakedGaussians:
    """The Gaussians, in the order and the axes of the file."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files.pop("meta.json"))
    pixels = {name: np.array(Image.open(io.BytesIO(data)).convert("RGBA")) for name, data in files.items()}
    count = meta["count"]
    assert meta["version"] == 2

    def rows(part: str, place: int = 0) -> NDArray[np.int64]:
        return pixels[meta[part]["files"][place]].reshape(-1, 4)[:count].astype(np.int64)

    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    logs = low + (high - low) * (rows("means") + 256 * rows("means", 1))[:, :3] / 65535
    sh0 = rows("sh0")
    sh = [np.array(meta["sh0"]["codebook"])[sh0[:, :3]][:, None]]
    if "shN" in meta:
        coefficients = (meta["shN"]["bands"] + 1) ** 2 - 1
        labels = rows("shN", 1)[:, 0] + 256 * rows("shN", 1)[:, 1]
        assert labels.max() < meta["shN"]["count"]
        table = np.array(meta["shN"]["codebook"])[pixels[meta["shN"]["files"][0]][..., :3]]
        assert table.shape[1] == 64 * coefficients
        sh.append(table.reshape(-1, 64, coefficients, 3)[labels // 64, labels % 64])
    return BakedGaussians(
        means=_tensor(np.sign(logs) * np.expm1(np.abs(logs))),
        quats=_quats(rows("quats")),
        scales=_tensor(np.array(meta["scales"]["codebook"])[rows("scales")[:, :3]]).exp(),
        opacities=_tensor(sh0[:, 3] / 255),
        sh=_tensor(np.concatenate(sh, axis=1)),
    )


def _quats(pixels: NDArray[np.int64]) -> torch.Tensor:
    found = np.zeros((len(pixels), 4))
    for row, (*three, tag) in zip(found, pixels, strict=True):
        others = [i for i in range(4) if i != tag - 252]
        row[others] = (np.array(three) / 255 * 2 - 1) / np.sqrt(2)
        row[tag - 252] = np.sqrt(max(0.0, 1 - (row**2).sum()))
    return _tensor(found)


def _tensor(values: NDArray[np.floating]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32)
