# SPDX-License-Identifier: Apache-2.0
"""Files opened again by a reader that was written from the format's description (``tests/support/sog_reader.py``)."""

from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.exporters.web import codebook, vector_palette
from structgstream.exporters.write import write_gaussians
from structgstream.geometry import quaternion_matrices
from structgstream.scene.order import morton_order
from tests.support.plain import picture, psnr, some
from tests.support.sog_reader import read_sog


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_sog_as_a_second_reader_reads_it(degree: int, tmp_path: Path) -> None:
    wanted = some(degree=degree)
    found = read_sog(write_gaussians(tmp_path / "set.sog", wanted, format="sog"))
    wanted = wanted.select(morton_order(wanted.means))
    assert found.degree == degree
    torch.testing.assert_close(found.means, wanted.means, atol=2e-4, rtol=1e-4)
    torch.testing.assert_close(found.scales.log(), wanted.scales.log(), atol=0.05, rtol=0)
    torch.testing.assert_close(found.opacities, wanted.opacities, atol=0.51 / 255, rtol=0)
    torch.testing.assert_close(found.sh, wanted.sh, atol=0.03, rtol=0)
    turns, wanted_turns = quaternion_matrices(found.quats), quaternion_matrices(wanted.quats)
    torch.testing.assert_close(turns, wanted_turns, atol=0.02, rtol=0)
    assert psnr(picture(found), picture(wanted)) > 38


def test_a_codebook_has_the_nearest_value_of_each() -> None:
    values = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    values[0, 0] = 40.0  # one far value does not make the others coarse
    book, indices = codebook(values)
    assert book.shape == (256,)
    assert np.array_equal(indices, np.abs(values[..., None] - book).argmin(-1))
    assert np.abs(book[indices] - values).mean() < 0.01
    assert abs(book[indices[0, 0]] - 40.0) < 0.01
    same, indices = codebook(np.full((5, 3), 2.0, np.float32))
    assert np.array_equal(same[indices], np.full((5, 3), 2.0))


def test_a_palette_has_at_most_as_many_entries_as_a_label_can_count() -> None:
    rows = np.random.default_rng(0).normal(size=(70_000, 3)).astype(np.float32)
    palette, labels = vector_palette(rows)
    assert palette.shape == (65_536, 3)
    assert np.array_equal(np.unique(labels), np.arange(65_536))
    assert np.abs(palette[labels] - rows).mean() < 0.02
