# SPDX-License-Identifier: Apache-2.0
"""The rigs, as a list: what is done to which camera."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from lab.rigs.filming import Filming
from lab.rigs.rig import BUMPED, NAMES
from lab.rigs.sound import Clap

Take = Literal["table", "fisheye", "ring"]
"""``table``: nine cameras before the table. ``fisheye``: the same places with fisheyes, traced ray by ray. ``ring``:
eight cameras around a board, and nothing else."""


@dataclass(frozen=True)
class Variant:
    """One rig.

    Args:
        what: a sentence for tables.
        cameras: how each camera films.
        frames: pictures of a camera that nothing befalls.
        take: what is before the cameras.
        claps: heard by all; an empty tuple is a rig without sound.
        board_frames: pictures of the film of a board; 0 for none.
        given: cameras that the given calibration has wrong; None where no calibration is given.
    """

    what: str
    cameras: Mapping[str, Filming]
    frames: int = 24
    take: Take = "table"
    claps: tuple[Clap, ...] = ()
    board_frames: int = 0
    given: tuple[str, ...] | None = field(default=None)


PLAIN = Filming()


def _all(filming: Filming = PLAIN, **others: Filming) -> dict[str, Filming]:
    """Every camera films as ``filming`` says, but for ``others``."""
    return {name: others.get(name, filming) for name in NAMES}


def _own(filming: Filming, *, focal: float, pixels: float, seed: int) -> dict[str, Filming]:
    """Every camera has its own focal length (within the share ``focal``) and principal point (within ``pixels``)."""
    rng = np.random.default_rng(seed)
    return {
        name: replace(
            filming,
            focal_factor=float(1 + rng.uniform(-focal, focal)),
            principal_offset=(float(rng.uniform(-pixels, pixels)), float(rng.uniform(-pixels, pixels))),
        )
        for name in NAMES
    }


def _begun(ticks: Mapping[str, int], **rates: float) -> dict[str, Filming]:
    return {name: Filming(begins_tick=ticks.get(name, 0), rate=rates.get(name, 1.0)) for name in NAMES}


# Ticks are half frames.
WHOLE = {"cam00": 8, "cam01": 2, "cam02": 14, "cam03": 0, "cam04": 20, "cam05": 6, "cam06": 10, "cam07": 4, "cam08": 26}
HALF = WHOLE | {"cam02": 13, "cam05": 7, "cam08": 25}
# 1.001 is a camera of 29.97 frames a second that states 30; quartz clocks are off by less, and need minutes to show it.
DRIFT = {"cam02": 1.001, "cam05": 0.9996, "cam08": 1.0002}
LIGHT = {
    "cam01": (0.35, (1.10, 1.0, 0.92)), "cam02": (-0.3, (0.93, 1.0, 1.12)), "cam04": (-0.6, (1.0, 1.0, 1.0)),
    "cam05": (0.2, (0.88, 1.0, 1.16)), "cam07": (0.5, (1.06, 1.0, 1.05)), "cam08": (-0.15, (1.15, 1.0, 0.85)),
}  # fmt: skip
CLAPS = (Clap(1.31, (-0.9, -0.9, 0.4)), Clap(2.17, (0.8, -1.0, 0.6)), Clap(4.02, (0.1, -0.7, 0.9)))

VARIANTS: Mapping[str, Variant] = {
    "mild": Variant("one good lens for all cameras, in step", _all()),
    "phone": Variant(
        "phones: distortion of 5 pixels that turns over, decentred; own focal lengths within 2 %",
        _own(Filming(lens="phone"), focal=0.02, pixels=6, seed=1),
    ),
    "fisheye": Variant("fisheyes of 150 degrees, each its own", _all(Filming(lens="fisheye")), take="fisheye"),
    "intrinsics": Variant(
        "own focal lengths within 6 % and principal points within 14 pixels",
        _own(Filming(), focal=0.06, pixels=14, seed=2),
    ),
    "whole": Variant("cameras started by hand, whole frames apart", _begun(WHOLE), frames=120),
    "half": Variant("the same, three of them half a frame more", _begun(HALF), frames=120),
    "drift": Variant(
        "half frames, and three clocks that are off by 0.2 to 1 in 1000", _begun(HALF, **DRIFT), frames=400
    ),
    "exposure": Variant(
        "exposure within 0.6 stops, white balance within 16 %",
        _all(**{name: Filming(stops=stops, white_balance=gains) for name, (stops, gains) in LIGHT.items()}),
    ),
    "dropped": Variant(
        "one camera drops a picture, another three in a row",
        _all(cam03=Filming(dropped=(5,)), cam06=Filming(dropped=(2, 3, 4))),
    ),
    "dead": Variant("a camera dies after its fourth picture", _all(cam07=Filming(dies_after=4))),
    "bumped": Variant(
        "somebody knocks against a camera at its eighth picture", _all(**{BUMPED: Filming(bumped_from=8)}), frames=24
    ),
    "given": Variant(
        "a calibration is given that has one camera off by 0.3 degrees and 8 mm", _all(), given=("cam06",)
    ),
    "sound": Variant("half frames apart, with sound: three claps", _begun(HALF), frames=150, claps=CLAPS),
    "board": Variant("one good lens, own focal lengths; a board is filmed first",
                     _own(Filming(), focal=0.03, pixels=8, seed=3), board_frames=120),
    "phone-board": Variant(
        "the phones; a board is filmed first",
        _own(Filming(lens="phone"), focal=0.02, pixels=6, seed=1),
        board_frames=120,
    ),
    "ring": Variant(
        "eight cameras around, of which neighbours alone see one side of the board",
        {f"cam{number:02d}": Filming() for number in range(8)}, take="ring", board_frames=160,
    ),
}  # fmt: skip
