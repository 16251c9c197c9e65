# SPDX-License-Identifier: Apache-2.0
"""``.glb``, ``.usd`` and ``.4dgs``, opened again: by readers of the library fourdgs, and by OpenUSD itself."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.errors import StreamError
from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import Format, FrameOptions
from structgstream.exporters.web import glb_bytes
from structgstream.exporters.write import FRAMES_FILES, open_output
from structgstream.harmonics import Y0
from tests.support.plain import RIG, picture, psnr, some

pytest.importorskip("pxr", reason="the extra export is not installed")
fourdgs = pytest.importorskip("fourdgs", reason="the extra export is not installed")
HALF_TURN = torch.tensor([1.0, -1.0, -1.0])
SH_STEP = 8.0 / 255.0
"""The reader keeps coefficients above the constant one in 8 bits from -4 to 4."""


def as_read(data: Any, rows: slice = slice(None)) -> BakedGaussians:
    """What fourdgs has read, as plain Gaussians in the axes of the file."""
    colors, count = data.colors[rows], len(data.positions[rows])
    sh = [torch.tensor((colors[:, :3] - 0.5) / Y0)[:, None]]
    if data.sh_degree:
        rest = torch.tensor(data.sh[rows].astype(np.float32) / 255 * 8 - 4).reshape(count, 3, -1)
        sh.append(rest.transpose(1, 2))
    return BakedGaussians(
        means=torch.tensor(np.asarray(data.positions[rows], np.float32)),
        quats=torch.tensor(np.asarray(data.rotations[rows], np.float32))[:, [3, 0, 1, 2]],
        scales=torch.tensor(np.asarray(data.scales[rows], np.float32)),
        opacities=torch.tensor(np.asarray(colors[:, 3], np.float32)),
        sh=torch.cat(sh, dim=1).float(),
    )


def check(found: BakedGaussians, wanted: BakedGaussians, *, within: float = 1e-5, colors: float = 1e-4) -> None:
    """Compares values, and a picture from a camera that is turned with the axes."""
    turned = wanted.y_up()
    inside = (0.5 + Y0 * turned.sh[:, 0] >= 0) & (0.5 + Y0 * turned.sh[:, 0] <= 1)  # the reader limits colours
    torch.testing.assert_close(found.means, turned.means, atol=within, rtol=within)
    torch.testing.assert_close(found.scales, turned.scales, atol=within, rtol=10 * within)
    torch.testing.assert_close(found.opacities, turned.opacities, atol=max(within, 1e-6), rtol=0)
    torch.testing.assert_close(found.sh[:, 0][inside], turned.sh[:, 0][inside], atol=colors, rtol=0)
    torch.testing.assert_close(found.sh[:, 1:], turned.sh[:, 1:], atol=0.51 * SH_STEP, rtol=0)
    assert (found.quats * turned.quats).sum(1).abs().min() > 1 - 10 * within
    camera = RIG["cam01"]
    alike = replace(camera, viewmat=camera.viewmat @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double())
    constant = ((0.5 + Y0 * turned.sh[:, :1]).clamp(0, 1) - 0.5) / Y0
    limited = replace(turned, sh=torch.cat([constant, turned.sh[:, 1:]], dim=1))
    assert psnr(picture(found, alike), picture(limited, alike)) > 38


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_glb_as_fourdgs_reads_it(degree: int, tmp_path: Path) -> None:
    wanted = some(degree=degree)
    (tmp_path / "set.glb").write_bytes(glb_bytes(wanted, FrameOptions()))
    imported = fourdgs.from_gltf(str(tmp_path / "set.glb"))
    assert imported.gaussians.count == len(wanted)
    assert imported.metadata["color_space"] == "srgb-rec709-display"
    check(as_read(imported.gaussians), wanted)


def frames(degree: int) -> list[BakedGaussians]:
    """Three frames of other counts, which move."""
    return [
        replace(part, means=part.means + t) for t, part in enumerate(some(300 - t, degree=degree) for t in range(3))
    ]


CODES = (4, 5, 9)
"""Times of the frames, in frames; a live run left some out."""


def write_all(path: Path, format: Format, parts: list[BakedGaussians]) -> Path:
    with open_output(path, format, fps=25.0, options=FrameOptions()) as write:
        for place, part in enumerate(parts):
            assert write(4 + place, CODES[place] / 25, part) == path
        assert not path.exists(), "complete or not there"
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    return path


@pytest.mark.parametrize("format", ["usd", "4dgs"])
def test_a_name_without_a_known_ending_is_a_folder(format: Format, tmp_path: Path) -> None:
    with open_output(tmp_path / "new", format, fps=25.0, options=FrameOptions()) as write:
        path = write(0, 0.0, some(40, degree=0))
    assert path == tmp_path / "new" / f"frames.{format}"
    assert path.is_file()


@pytest.mark.parametrize("degree", [0, 1])
def test_4dgs_has_every_frame_at_its_time(degree: int, tmp_path: Path) -> None:
    parts = frames(degree)
    scene = fourdgs.read(str(write_all(tmp_path / "all.4dgs", "4dgs", parts)))
    assert scene.gaussians.count == 897
    for wanted, at in zip((parts[0], parts[1], parts[1], parts[2]), (0.5, 1.5, 4.5, 5.5), strict=True):
        rows = scene.gaussians.state_at(at / 25)["indices"]
        found = as_read(scene.gaussians, rows)
        assert len(found) == len(wanted)
        # The writer sorts: nearest positions are compared.
        nearest = torch.cdist(wanted.y_up().means, found.means).argmin(1)
        check(found.select(nearest), wanted, within=5e-3, colors=0.02)


USD_READER = """
import sys, numpy as np
from pxr import Usd, UsdGeom
stage = Usd.Stage.Open(sys.argv[1])
prim = stage.GetDefaultPrim()
assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (4, 9, 25)
assert UsdGeom.GetStageUpAxis(stage) == "Y"
names = "positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients", "extent"
found = {"degree": prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()}
for name in names:
    attribute = prim.GetAttribute(name)
    assert attribute.IsDefined() and attribute.GetTimeSamples() == [4, 5, 9]
    found |= {f"{name} {time}": np.array(attribute.Get(time)) for time in (4, 5, 9)}
np.savez(sys.argv[2], **found)
"""


def test_usd_has_a_time_sample_of_each_frame(tmp_path: Path) -> None:
    """In a process of its own, with nothing of this package."""
    parts = frames(2)
    (tmp_path / "out").mkdir()
    path = write_all(tmp_path / "out" / "all.usd", "usd", parts)
    subprocess.run([sys.executable, "-c", USD_READER, str(path), str(tmp_path / "found.npz")], check=True)
    data = np.load(tmp_path / "found.npz")
    for time, wanted in zip(CODES, parts, strict=True):
        turned, read = (
            wanted.y_up(),
            {k.split()[0]: torch.tensor(data[k]) for k in data.files if k.endswith(f" {time}")},
        )
        torch.testing.assert_close(read["positions"], turned.means)
        torch.testing.assert_close(read["orientations"][:, [3, 0, 1, 2]], turned.quats)
        torch.testing.assert_close(read["scales"], turned.scales)
        torch.testing.assert_close(read["opacities"], turned.opacities)
        torch.testing.assert_close(read["radiance:sphericalHarmonicsCoefficients"].reshape(-1, 9, 3), turned.sh)
        low, high = read["extent"]
        assert ((turned.means > low) & (turned.means < high)).all()
    assert int(data["degree"]) == 2


def test_usd_of_one_frame_as_fourdgs_reads_it(tmp_path: Path) -> None:
    """The library reads what an OpenUSD stage has by default, which a text file with samples turned off shows."""
    from pxr import Usd  # pyright: ignore[reportMissingImports]

    path = write_all(tmp_path / "one.usda", "usd", [some(40, degree=1)])
    stage = Usd.Stage.Open(str(path))  # pyright: ignore[reportAttributeAccessIssue]
    for attribute in stage.GetDefaultPrim().GetAttributes():
        if samples := attribute.GetTimeSamples():
            attribute.Set(attribute.Get(samples[0]))
    stage.Save()
    check(as_read(fourdgs.from_usd(str(path)).gaussians), some(40, degree=1))


@pytest.mark.parametrize("format", ["usd", "4dgs"])
def test_a_frame_that_no_file_can_hold_leaves_no_file(format: Format, tmp_path: Path) -> None:
    bad = replace(some(3), means=torch.full((3, 3), torch.nan))
    with pytest.raises(StreamError, match="The means of 3 of 3"):
        write_all(tmp_path / f"x.{format}", format, [bad])
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("format", ["usd", "4dgs"])
def test_an_interruption_leaves_no_file(format: Format, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(collected: object, path: Path) -> None:
        path.write_bytes(b"part")
        raise KeyboardInterrupt

    monkeypatch.setattr(FRAMES_FILES[format], "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_all(tmp_path / f"x.{format}", format, [some(3)])
    assert not [*tmp_path.iterdir()]
