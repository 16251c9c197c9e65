# SPDX-License-Identifier: Apache-2.0
"""``truth.json``: what is known of a rig, exact as it was filmed."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from structgstream.cameras import Camera
from structgstream.data.lenses import Fisheye, Lens, LensCamera, Pinhole, RadialTangential

FILE = "truth.json"
LENSES: Mapping[str, type[Lens]] = {"pinhole": Pinhole, "opencv": RadialTangential, "fisheye": Fisheye}


@dataclass(frozen=True)
class TrueCamera:
    """One camera.

    Args:
        filmed: lens, intrinsics and pose, in metres.
        offset_seconds: common time = ``offset_seconds + rate * stamp``.
        rate: see ``offset_seconds``.
        stops: exposure over that of the rig, in powers of two.
        white_balance: gains of red, green and blue in linear light.
        dropped: stamps (seconds) of pictures that the file lacks.
        ends: stamp at which a camera has died, or None.
        bumped: stamp from which on it stands elsewhere, and its view matrix then; or None.
    """

    filmed: LensCamera
    offset_seconds: float = 0.0
    rate: float = 1.0
    stops: float = 0.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    dropped: tuple[float, ...] = ()
    ends: float | None = None
    bumped: tuple[float, torch.Tensor] | None = None


@dataclass(frozen=True)
class Truth:
    """A rig and what befell it.

    Args:
        variant: its name.
        what: one sentence.
        fps: frames a second of the common time.
        near: metres; nothing is nearer to a camera.
        held_out: the camera for scores, or None for a rig that is only calibrated.
        cameras: by name.
        claps: instant (common time, seconds) and place (metres) of every clap.
        board: what OpenCV calls the board that was filmed, in ``board/``; or None.
        given: names of cameras that the given ``calibration.json`` has wrong; None where none is given.
    """

    variant: str
    what: str
    fps: float
    near: float
    held_out: str | None
    cameras: Mapping[str, TrueCamera]
    claps: tuple[tuple[float, tuple[float, float, float]], ...] = ()
    board: Mapping[str, Any] | None = None
    given: tuple[str, ...] | None = field(default=None)


def write_truth(folder: Path, truth: Truth) -> None:
    """Writes ``truth.json`` into a folder."""
    content = {
        "variant": truth.variant, "what": truth.what, "fps": truth.fps, "unit": "metres", "near": truth.near,
        "held_out": truth.held_out, "claps": [{"seconds": s, "place": list(p)} for s, p in truth.claps],
        "board": truth.board, "given": truth.given, "licence": "CC0-1.0",
        "convention": "viewmat: world to camera, OpenCV axes; the top-left pixel's centre is (0.5, 0.5); "
        "common time = offset_seconds + rate * stamp",
        "cameras": {name: _entry(camera) for name, camera in truth.cameras.items()},
    }  # fmt: skip
    (folder / FILE).write_text(json.dumps(content, indent=1) + "\n")


def read_truth(folder: Path) -> Truth:
    """What :func:`write_truth` wrote."""
    content = json.loads((folder / FILE).read_text())
    return Truth(
        variant=content["variant"],
        what=content["what"],
        fps=content["fps"],
        near=content["near"],
        held_out=content["held_out"],
        cameras={name: _camera(entry, content["near"]) for name, entry in content["cameras"].items()},
        claps=tuple((clap["seconds"], tuple(clap["place"])) for clap in content["claps"]),
        board=content["board"],
        given=None if content["given"] is None else tuple(content["given"]),
    )


def _entry(camera: TrueCamera) -> dict[str, Any]:
    own = camera.filmed.camera
    lens = camera.filmed.lens
    model = next(name for name, kind in LENSES.items() if type(lens) is kind)
    bumped = camera.bumped and {"from": camera.bumped[0], "viewmat": camera.bumped[1].tolist()}
    return {
        "size": [own.width, own.height], "K": own.K.tolist(), "viewmat": own.viewmat.tolist(),
        "lens": {"model": model, **asdict(lens)},
        "clock": {"offset_seconds": camera.offset_seconds, "rate": camera.rate},
        "stops": camera.stops, "white_balance": list(camera.white_balance),
        "dropped": list(camera.dropped), "ends": camera.ends, "bumped": bumped,
    }  # fmt: skip


def _camera(entry: Mapping[str, Any], near: float) -> TrueCamera:
    lens = dict(entry["lens"])
    kind = LENSES[lens.pop("model")]
    own = Camera(_exact(entry["viewmat"]), _exact(entry["K"]), *entry["size"], near=near)
    bumped = entry["bumped"]
    return TrueCamera(
        filmed=LensCamera(own, kind(**lens)),
        offset_seconds=entry["clock"]["offset_seconds"],
        rate=entry["clock"]["rate"],
        stops=entry["stops"],
        white_balance=tuple(entry["white_balance"]),
        dropped=tuple(entry["dropped"]),
        ends=entry["ends"],
        bumped=None if bumped is None else (bumped["from"], _exact(bumped["viewmat"])),
    )


def _exact(values: list[list[float]]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)
