# SPDX-License-Identifier: Apache-2.0
"""The page of a report shows every crop, pixel for pixel."""

from pathlib import Path

import numpy as np

from structgstream.evaluation.worst import Crop, write_page
from tests.support.drawn import pixels_of


def test_every_crop_is_on_the_page_with_its_reason(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    pictures = [random.integers(0, 256, (20, 68, 3)).astype(np.uint8) for _ in range(2)]
    crops = [
        Crop("changed", 2, "cam/0", "camera <0>: 20.00 dB", pictures[0]),
        Crop("ghosts", 3, "cam/0", "20.0% of the picture", pictures[1]),
    ]
    write_page(tmp_path, crops, title="a <title>", pictures=["over_time.png"])
    page = (tmp_path / "index.html").read_text()
    assert "a &lt;title&gt;" in page
    assert "<figcaption>camera &lt;0&gt;: 20.00 dB</figcaption>" in page
    assert "20.0% of the picture" in page
    names = [f"worst/{name}-cam_0.png" for name in ("changed-000002", "ghosts-000003")]
    assert page.index(names[0]) < page.index(names[1]) < page.index("over_time.png")
    for name, picture in zip(names, pictures, strict=True):
        np.testing.assert_array_equal(pixels_of(tmp_path / name), picture)


def test_a_report_without_crops_has_a_page(tmp_path: Path) -> None:
    write_page(tmp_path, [], title="nothing moves", pictures=["over_time.png"])
    page = (tmp_path / "index.html").read_text()
    assert "over_time.png" in page
    assert "<h2>" not in page
