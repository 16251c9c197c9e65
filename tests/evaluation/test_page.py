# SPDX-License-Identifier: Apache-2.0
"""The page of a report shows every crop, pixel for pixel."""

from pathlib import Path

import numpy as np

from structgstream.evaluation.worst import Crop, Window, write_page
from tests.support.drawn import pixels_of


def test_every_crop_is_on_the_page_with_its_reason(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    pictures = [random.integers(0, 256, (20, 68, 3)).astype(np.uint8) for _ in range(2)]
    window = Window(12, 34, 20, 20)
    crops = [
        Crop("changed", 2, "cam/0", {"psnr_changed": 20.0}, window, pictures[0]),
        Crop("ghosts", 3, "cam/0", {"ghost_share": 0.2, "disoccluded_share": 0.1}, window, pictures[1]),
    ]
    write_page(tmp_path, crops, title="a <title>", pictures=["over_time.png"])
    page = (tmp_path / "index.html").read_text()
    assert "a &lt;title&gt;" in page
    assert "Frame 2, camera cam/0: 20.00 dB on changed pixels; 20x20 pixels at (12, 34)" in page
    assert "20.0% of the disoccluded pixels, which are 10.0% of the picture" in page
    names = [f"worst/{name}-cam_0.png" for name in ("changed-000002", "ghosts-000003")]
    assert page.index(names[0]) < page.index(names[1]) < page.index("over_time.png")
    for name, picture in zip(names, pictures, strict=True):
        np.testing.assert_array_equal(pixels_of(tmp_path / name), picture)


def test_a_report_without_crops_has_a_page(tmp_path: Path) -> None:
    write_page(tmp_path, [], title="nothing moves", pictures=["over_time.png"])
    page = (tmp_path / "index.html").read_text()
    assert "over_time.png" in page
    assert "<h2>" not in page
