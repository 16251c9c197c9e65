# SPDX-License-Identifier: Apache-2.0
"""Surfaces of the set table."""

import textures as tx
from materials import (
    BRIGHT,
    CLARET,
    CLOTH,
    CREAM,
    NAVY,
    OCHRE,
    RUST,
    SAGE,
    TEAL,
    Surface,
    glass,
    image,
    metal,
    painted,
)


def all_surfaces() -> dict[str, Surface]:
    """Every material by name; made once, since shapes that share one also share its compiled code."""
    walnut = tx.wood(1024, (0.20, 0.10, 0.06), (0.52, 0.31, 0.18), seed=1, planks=8)
    oak = tx.wood(512, (0.44, 0.29, 0.17), (0.74, 0.56, 0.37), seed=2)
    glazes = (TEAL, TEAL, (0.30, 0.56, 0.52), SAGE, CREAM, (0.66, 0.74, 0.66), NAVY, (0.42, 0.62, 0.62))
    stones = (CREAM, RUST, (0.42, 0.38, 0.36), OCHRE, (0.62, 0.56, 0.50), (0.28, 0.30, 0.32))
    leaves = (SAGE, (0.34, 0.48, 0.36), OCHRE, (0.72, 0.46, 0.32), (0.62, 0.66, 0.48))
    ground = (0.80, 0.74, 0.62)
    surfaces = {
        "table": painted(image(walnut), roughness=0.2, specular=0.6, coat=1.0),
        "oak": painted(image(oak), roughness=0.45, specular=0.4),
        "tiles": painted(image(tx.tiles(1024, 14, glazes, seed=3)), roughness=0.22, coat=0.3),
        "floor": painted(
            image(tx.terrazzo(1024, 420, stones, base=(0.74, 0.70, 0.64), seed=4)),
            roughness=0.35,
            specular=0.4,
        ),
        "paper": painted(image(tx.foliage(1024, 190, leaves, ground=ground, seed=5)), roughness=0.8, specular=0.2),
        "plaster": painted(
            image(tx.marble(512, (0.72, 0.66, 0.56), (0.90, 0.86, 0.78), seed=6)), roughness=0.9, specular=0.1
        ),
        "runner": painted(image(tx.kilim(1024, 10, CLOTH, seed=7)), roughness=0.9, specular=0.1),
        "towel": painted(image(tx.kilim(1024, 5, CLOTH, seed=19)), roughness=0.9, specular=0.1),
        "crock": painted(
            image(tx.marble(512, (0.16, 0.30, 0.44), (0.86, 0.85, 0.80), seed=8, veins=2.2)),
            roughness=0.15,
            coat=0.8,
        ),
        "vase": painted(
            image(tx.tiles(512, 9, (OCHRE, RUST, CREAM, CLARET), seed=9), (1.0, 1.0)), roughness=0.2, coat=0.8
        ),
        "clay": painted(
            image(tx.marble(512, (0.45, 0.21, 0.13), (0.66, 0.38, 0.25), seed=10)),
            roughness=0.7,
            specular=0.2,
        ),
        "block": painted(image(tx.toy_block(768, BRIGHT, seed=11)), roughness=0.4, specular=0.4),
        "ball": painted(image(tx.playball(512, BRIGHT, seed=12)), roughness=0.2, coat=0.6),
        "jack": painted(
            image(tx.playball(512, (BRIGHT[2], (0.95, 0.52, 0.14), BRIGHT[2], BRIGHT[0]), seed=13)),
            roughness=0.3,
        ),
        "chest": painted(image(tx.wood(512, (0.16, 0.30, 0.30), (0.36, 0.56, 0.54), seed=14, planks=4)), roughness=0.5),
        "jelly": painted((0.50, 0.035, 0.05), roughness=0.12, specular=0.6, coat=1.0),
        "juice": painted((0.86, 0.26, 0.015), roughness=0.12, specular=0.6, coat=1.0),
        "plate": painted(
            image(tx.marble(512, (0.80, 0.79, 0.74), (0.88, 0.87, 0.83), seed=15)), roughness=0.15, coat=0.8
        ),
        "leaf0": painted((0.06, 0.20, 0.05), roughness=0.4),
        "leaf1": painted((0.12, 0.28, 0.07), roughness=0.4),
        "leaf2": painted((0.19, 0.34, 0.11), roughness=0.4),
        "lemon": painted(
            image(tx.marble(256, (0.90, 0.66, 0.12), (0.96, 0.80, 0.24), seed=16)),
            roughness=0.4,
            specular=0.4,
        ),
        "copper": metal("Cu", along=0.07, across=0.07),
        "brass": metal("Au", along=0.16, across=0.16),
        "steel": metal("Al", along=0.10, across=0.32),
        "glass": glass(),
    }
    for number in range(4):
        palette = [
            (CREAM, OCHRE, *BRIGHT),
            (TEAL, SAGE, *BRIGHT),
            (NAVY, TEAL, *BRIGHT),
            (RUST, CREAM, *CLOTH),
        ][number]
        surfaces[f"picture{number}"] = painted(
            image(tx.picture(512, palette, seed=20 + number)), roughness=0.5, specular=0.3
        )
    for number, color in enumerate((CLARET, NAVY, OCHRE, SAGE, RUST, TEAL)):
        cover = tx.kilim(256, 3, (color, color, tuple(0.6 * c for c in color), CREAM), seed=30 + number)
        surfaces[f"book{number}"] = painted(image(cover), roughness=0.6, specular=0.3)
    return surfaces
