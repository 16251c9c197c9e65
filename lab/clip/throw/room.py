# SPDX-License-Identifier: Apache-2.0
"""What stands still: a hall, a rug, a bookcase, plants, crates, and the stool with the globe."""

import numpy as np
from meshes import Parts, box, revolved, rotation, sheet, smooth_profile, sphere
from props import books, picture, plant

from throw.cloth import GLOBE_RADIUS, STOOL_RADIUS, STOOL_TOP

STOOL = (-0.22, 1.05)  # where the stool stands


def walls() -> Parts:
    """Floor, walls and ceiling. Everything a camera can see carries texture."""
    return {
        "floor": (box((8.4, 9.4, 0.1), metres_per_repeat=2.2).placed((0, -0.4, -0.05)), "floor"),
        "ceiling": (box((8.4, 9.4, 0.1), metres_per_repeat=2.2).placed((0, -0.4, 3.08)), "plaster"),
        "wainscot": (box((8.4, 0.1, 1.0), metres_per_repeat=1.7).placed((0, 2.45, 0.5)), "tiles"),
        "back": (box((8.4, 0.1, 2.2), metres_per_repeat=1.5).placed((0, 2.46, 2.05)), "paper"),
        "rail": (box((8.4, 0.07, 0.06), metres_per_repeat=1.0).placed((0, 2.39, 1.02)), "oak"),
        "left": (box((0.1, 9.4, 3.2), metres_per_repeat=1.5).placed((-3.3, -0.4, 1.55)), "paper"),
        "right": (box((0.1, 9.4, 3.2), metres_per_repeat=1.7).placed((3.3, -0.4, 1.55)), "tiles"),
    }


def furniture() -> Parts:
    """Rug, bookcase, pictures, stool."""
    x, y = np.meshgrid(np.linspace(-1.75, 1.75, 120), np.linspace(-1.25, 0.75, 60), indexing="ij")
    height = 0.008 + 0.003 * np.sin(9 * x + 3) * np.cos(7 * y)
    parts: Parts = {
        "rug": (sheet(np.stack([x, y, height], -1), np.stack([x / 1.7, y / 1.7], -1)), "rug"),
    }
    seat = [(0, STOOL_TOP), (STOOL_RADIUS - 0.01, STOOL_TOP), (STOOL_RADIUS, STOOL_TOP - 0.015),
            (STOOL_RADIUS - 0.01, STOOL_TOP - 0.05), (0.05, STOOL_TOP - 0.06), (0.045, 0.06), (0.17, 0.03), (0.17, 0),
            (0, 0)]  # fmt: skip
    parts["stool"] = (revolved(seat).placed((*STOOL, 0)), "stool")
    globe = sphere(GLOBE_RADIUS).placed((*STOOL, STOOL_TOP + GLOBE_RADIUS - 0.01), rotation("y", 20))
    parts["globe"] = (globe, "globe")
    for number, (width, tall, at_x, at_z) in enumerate(
        [(0.95, 0.70, 0.75, 1.60), (0.62, 0.80, 1.75, 1.66), (0.9, 0.66, -0.55, 1.62), (0.6, 0.8, 2.6, 1.6)]
    ):
        frame = box((width + 0.09, 0.04, tall + 0.09), metres_per_repeat=0.5).placed((at_x, 2.39, at_z))
        parts[f"frame{number}"] = (frame, "oak")
        parts[f"picture{number}"] = (picture(width, tall).placed((at_x, 2.365, at_z)), f"picture{number}")
    return parts


def bookcase() -> Parts:
    """Three boards of books at the left."""
    parts: Parts = {}
    x, y = -1.75, 2.15
    for number, post_x in enumerate((x - 0.62, x + 0.62)):
        parts[f"side{number}"] = (box((0.04, 0.34, 1.55), metres_per_repeat=0.8).placed((post_x, y, 0.775)), "walnut")
    for number, z in enumerate((0.10, 0.56, 1.02, 1.52)):
        parts[f"board{number}"] = (box((1.24, 0.34, 0.035), metres_per_repeat=0.8).placed((x, y, z)), "walnut")
        if number < 3:
            row = books((x - 0.57, y - 0.03, z + 0.018), count=13, seed=40 + number, size=1.9, name=f"book{number}-")
            parts |= row
    parts["case-back"] = (box((1.24, 0.02, 1.5), metres_per_repeat=0.8).placed((x, y + 0.16, 0.78)), "walnut")
    return parts


def goods() -> Parts:
    """Plants in pots, crates, a copper ball, a jar."""
    pot = [(0, 0), (0.13, 0), (0.17, 0.24), (0.18, 0.27), (0.16, 0.27), (0.15, 0.23), (0, 0.23)]
    jar = [(0, 0), (0.12, 0), (0.2, 0.16), (0.1, 0.42), (0.13, 0.52), (0.11, 0.52), (0.08, 0.42), (0, 0.40)]
    parts: Parts = {
        "pot": (revolved(smooth_profile(pot)).placed((0.72, 1.95, 0)), "clay"),
        "jar": (revolved(smooth_profile(jar)).placed((-0.78, 1.90, 0)), "vase"),
        "copper": (sphere(0.17).placed((0.42, 1.20, 0.17)), "copper"),
        "crate0": (
            box((0.55, 0.5, 0.46), metres_per_repeat=0.5).placed((1.95, 1.55, 0.23), rotation("z", 14)),
            "crate",
        ),
        "crate1": (box((0.40, 0.40, 0.36), atlas=True).placed((1.92, 1.55, 0.64), rotation("z", -18)), "block"),
        "crate2": (
            box((0.5, 0.45, 0.5), metres_per_repeat=0.5).placed((-2.75, 0.95, 0.25), rotation("z", 30)),
            "crate",
        ),
    }
    parts |= plant((0.72, 1.95, 0.24), leaves=30, length=(0.35, 0.75), seed=5, name="palm")
    parts |= plant((-0.78, 1.90, 0.48), leaves=14, length=(0.25, 0.5), seed=9, name="bouquet")
    return parts


def still_parts() -> Parts:
    """Everything that never moves."""
    return walls() | furniture() | bookcase() | goods()
