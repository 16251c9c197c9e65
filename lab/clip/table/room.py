# SPDX-License-Identifier: Apache-2.0
"""What stands still: room, table and things."""

import numpy as np
from meshes import Mesh, Parts, box, revolved, sheet, smooth_profile, sphere, tube
from props import books, picture, plant

TAP = np.array([0.10, 0.075, 0.235])  # the mouth of the tap; the glass stands under it


def walls() -> Parts:
    """Floor, walls and ceiling. Everything a camera can see carries texture."""
    return {
        "floor": (box((5.4, 5.4, 0.1), metres_per_repeat=1.5).placed((0, 0, -0.80)), "floor"),
        "ceiling": (box((5.4, 5.4, 0.1), metres_per_repeat=1.5).placed((0, 0, 2.25)), "plaster"),
        "splash": (box((4.4, 0.1, 1.2), metres_per_repeat=1.25).placed((0, 1.2, -0.25)), "tiles"),
        "back": (box((4.4, 0.1, 1.9), metres_per_repeat=0.95).placed((0, 1.21, 1.30)), "paper"),
        "rail": (box((4.4, 0.05, 0.035), metres_per_repeat=0.7).placed((0, 1.15, 0.355)), "oak"),
        "left": (box((0.1, 5.4, 3.1), metres_per_repeat=0.95).placed((-1.75, 0, 0.70)), "paper"),
        "right": (box((0.1, 5.4, 3.1), metres_per_repeat=1.25).placed((1.75, 0, 0.70)), "tiles"),
    }


def furniture() -> Parts:
    """Table, runner, shelf and pictures."""
    parts: Parts = {
        "table": (box((1.70, 1.14, 0.045), metres_per_repeat=1.1).placed((0, 0.01, -0.0225)), "table"),
        "apron": (box((1.56, 0.92, 0.12), metres_per_repeat=0.6).placed((0, 0.05, -0.105)), "oak"),
        "cupboard": (box((1.40, 0.70, 0.62), metres_per_repeat=0.7).placed((0, 0.12, -0.45)), "chest"),
        "runner": (_runner(), "runner"),
        "shelf": (box((1.05, 0.2, 0.028), metres_per_repeat=0.5).placed((-0.42, 1.06, 0.46)), "oak"),
    }
    for number, (width, height, x, z) in enumerate(
        [
            (0.46, 0.34, 0.46, 0.66),
            (0.34, 0.42, 0.96, 0.70),
            (0.5, 0.36, -1.2, 1.05),
            (0.46, 0.34, -0.35, 1.06),
        ]
    ):
        frame = box((width + 0.05, 0.025, height + 0.05), metres_per_repeat=0.3).placed((x, 1.148, z))
        parts[f"frame{number}"] = (frame, "oak")
        parts[f"picture{number}"] = (picture(width, height).placed((x, 1.133, z)), f"picture{number}")
    return parts


def _runner() -> Mesh:
    """A cloth along the table that hangs over neither edge and lies a little unevenly."""
    x, y = np.meshgrid(np.linspace(-0.80, 0.80, 120), np.linspace(-0.07, 0.17, 24), indexing="ij")
    height = 0.004 + 0.0015 * np.sin(17 * x + 3) * np.cos(11 * y)
    return sheet(np.stack([x, y, height], -1), np.stack([x / 0.8, y / 0.8], -1))


def shelf_goods() -> Parts:
    """Books, a plant and a bowl on the shelf."""
    parts = books((-0.90, 1.05, 0.474), count=10, seed=2)
    pot = [(0, 0), (0.055, 0), (0.075, 0.10), (0.08, 0.115), (0.07, 0.115), (0.065, 0.10), (0, 0.10)]
    parts["pot"] = (revolved(smooth_profile(pot)).placed((-0.33, 1.05, 0.474)), "clay")
    parts |= plant((-0.33, 1.05, 0.58), leaves=22, length=(0.09, 0.18), seed=5, name="fern")
    bowl = [(0, 0.010), (0.045, 0.014), (0.09, 0.06), (0.095, 0.06), (0.05, 0.004), (0, 0)]
    parts["bowl"] = (revolved(smooth_profile(bowl)).placed((-0.07, 1.05, 0.474)), "vase")
    for number, (dx, dy, z) in enumerate([(-0.03, 0.0, 0.525), (0.035, 0.01, 0.525), (0.0, -0.005, 0.566)]):
        parts[f"lemon{number}"] = (sphere(0.033).placed((-0.07 + dx, 1.05 + dy, z)), "lemon")
    return parts


def table_goods() -> Parts:
    """Dispenser and tap, glass, metal things, vase, plate, the jack's chest and the towel's stand."""
    x, y = TAP[0], 0.26
    crock = [(0, 0), (0.085, 0), (0.105, 0.02), (0.112, 0.10), (0.105, 0.19), (0.085, 0.215), (0.088, 0.225),
             (0.06, 0.240), (0.012, 0.250), (0.018, 0.268), (0, 0.275)]  # fmt: skip
    bend = np.linspace(0, 1, 28)
    tap = np.stack([np.full(28, x), 0.16 - 0.085 * np.sin(bend * np.pi / 2), 0.275 - 0.04 * bend**6], -1)
    can = [(0, 0), (0.062, 0), (0.066, 0.006), (0.066, 0.15), (0.060, 0.165), (0.052, 0.170), (0.010, 0.178),
           (0.014, 0.195), (0, 0.20)]  # fmt: skip
    vase = [
        (0, 0),
        (0.045, 0),
        (0.078, 0.07),
        (0.032, 0.17),
        (0.042, 0.21),
        (0.036, 0.21),
        (0.026, 0.17),
        (0, 0.16),
    ]
    plate = [(0, 0.008), (0.06, 0.008), (0.105, 0.020), (0.11, 0.018), (0.06, 0), (0, 0)]
    glass = [(0.034, 0.004), (0.043, 0.115)]
    parts: Parts = {
        "stand": (box((0.2, 0.2, 0.20), metres_per_repeat=0.35).placed((x, y, 0.10)), "oak"),
        "crock": (revolved(smooth_profile(crock)).placed((x, y, 0.20)), "crock"),
        "tap": (tube(tap, 0.013), "brass"),
        "handle": (tube(np.linspace((x, 0.10, 0.28), (x, 0.10, 0.315), 8), 0.007), "brass"),
        "knob": (sphere(0.014).placed((x, 0.10, 0.322)), "brass"),
        "glass": (revolved(glass).placed((x, TAP[1], 0.004)), "glass"),
        "coaster": (
            revolved(smooth_profile([(0, 0.008), (0.055, 0.008), (0.058, 0.0)])).placed((x, TAP[1], 0.0)),
            "clay",
        ),
        "copper": (sphere(0.08).placed((0.42, -0.12, 0.08)), "copper"),
        "can": (revolved(smooth_profile(can, samples=120)).placed((-0.24, 0.28, 0)), "steel"),
        "vase": (revolved(smooth_profile(vase)).placed((-0.58, 0.30, 0)), "vase"),
        "plate": (revolved(smooth_profile(plate)).placed((-0.40, 0.03, 0.005)), "plate"),
    }
    parts |= plant((-0.58, 0.30, 0.19), leaves=16, length=(0.12, 0.24), seed=9, name="bouquet")
    for number, (dx, dy, size) in enumerate(
        [(0.066, 0, (0.010, 0.142, 0.155)), (-0.066, 0, (0.010, 0.142, 0.155)),
         (0, 0.066, (0.122, 0.010, 0.155)), (0, -0.066, (0.122, 0.010, 0.155))]
    ):  # fmt: skip
        parts[f"chest{number}"] = (
            box(size, metres_per_repeat=0.22).placed((0.21 + dx, -0.22 + dy, 0.0785)),
            "chest",
        )
    for number, post_x in enumerate((0.44, 0.80)):
        post = tube(np.linspace((post_x, 0.36, 0), (post_x, 0.36, 0.47), 8), 0.009)
        parts[f"post{number}"] = (post, "brass")
        parts[f"finial{number}"] = (sphere(0.016).placed((post_x, 0.36, 0.475)), "brass")
    parts["rod"] = (tube(np.linspace((0.44, 0.36, 0.455), (0.80, 0.36, 0.455), 8), 0.007), "brass")
    return parts


def still_parts() -> Parts:
    """Everything that never moves."""
    return walls() | furniture() | shelf_goods() | table_goods()
