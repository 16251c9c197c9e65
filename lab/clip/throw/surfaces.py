# SPDX-License-Identifier: Apache-2.0
"""Surfaces of the throw."""

import textures as tx
from materials import BRIGHT, CLARET, CLOTH, CREAM, NAVY, OCHRE, RUST, SAGE, TEAL, Surface, image, metal, painted

SKINS = {"dark": (0.44, 0.27, 0.18), "fair": (0.86, 0.64, 0.50)}
HAIRS = {"dark": (0.10, 0.07, 0.06), "fair": (0.62, 0.40, 0.16)}


def clothes() -> dict[str, Surface]:
    """What the two figures wear, and their heads and hands."""
    argyle = tx.kilim(512, 4, (CLARET, CREAM, NAVY, OCHRE), seed=51)
    hoops = tx.tartan(512, ((0.16, 0.50, 0.34), CREAM, (0.14, 0.38, 0.60)), across=0, along=7, seed=52)
    jeans = tx.tartan(512, ((0.20, 0.30, 0.46), (0.28, 0.40, 0.56), (0.14, 0.20, 0.34)), across=9, along=0, seed=53)
    checks = tx.tartan(512, (RUST, CREAM, TEAL), across=4, along=6, seed=54)
    surfaces = {
        "argyle": painted(image(argyle, (2.0, 1.0)), roughness=0.9, specular=0.1),
        "argyle-sleeve": painted(image(argyle, (0.5, 0.5)), roughness=0.9, specular=0.1),
        "hoops": painted(image(hoops), roughness=0.9, specular=0.1),
        "hoops-sleeve": painted(image(hoops, (1.0, 0.5)), roughness=0.9, specular=0.1),
        "denim": painted(image(jeans), roughness=0.9, specular=0.1),
        "checks": painted(image(checks), roughness=0.9, specular=0.1),
        "shoe-red": painted((0.45, 0.03, 0.03), roughness=0.4),
        "shoe-blue": painted((0.03, 0.10, 0.40), roughness=0.4),
    }  # fmt: skip
    for name in SKINS:
        head = tx.face(512, SKINS[name], HAIRS[name], seed=55)
        surfaces[f"head-{name}"] = painted(image(head), roughness=0.6, specular=0.3)
        hand = tx.marble(128, SKINS[name], tuple(1.08 * c for c in SKINS[name]), seed=56)
        surfaces[f"skin-{name}"] = painted(image(hand), roughness=0.6, specular=0.3)
    return surfaces


def all_surfaces() -> dict[str, Surface]:
    """Every material by name."""
    glazes = (SAGE, SAGE, CREAM, (0.74, 0.72, 0.60), OCHRE, (0.60, 0.66, 0.54), (0.80, 0.60, 0.46))
    stones = (CREAM, (0.42, 0.38, 0.36), (0.62, 0.56, 0.50), (0.28, 0.30, 0.32), TEAL)
    leaves = (TEAL, (0.24, 0.42, 0.50), NAVY, (0.52, 0.62, 0.66), SAGE)
    oak = tx.wood(512, (0.44, 0.29, 0.17), (0.74, 0.56, 0.37), seed=62)
    walnut = tx.wood(512, (0.22, 0.12, 0.07), (0.50, 0.30, 0.18), seed=63, planks=4)
    crate = tx.wood(512, (0.46, 0.34, 0.20), (0.78, 0.62, 0.42), seed=64, planks=5)
    rug = tx.kilim(1024, 5, (NAVY, TEAL, CREAM, SAGE, (0.40, 0.50, 0.58)), seed=68)
    cloth = tx.kilim(1024, 5, ((0.82, 0.76, 0.2), (0.86, 0.82, 0.74), (0.46, 0.20, 0.50), (0.20, 0.48, 0.44)), seed=69)
    surfaces = clothes() | {
        "floor": painted(
            image(tx.terrazzo(1024, 420, stones, base=(0.74, 0.70, 0.64), seed=61)), roughness=0.35, specular=0.4
        ),
        "oak": painted(image(oak), roughness=0.45, specular=0.4),
        "stool": painted(image(oak, (2.0, 1.0)), roughness=0.45, specular=0.4),
        "walnut": painted(image(walnut), roughness=0.4, specular=0.4),
        "crate": painted(image(crate), roughness=0.6, specular=0.3),
        "tiles": painted(image(tx.tiles(1024, 12, glazes, seed=65)), roughness=0.25, coat=0.2),
        "paper": painted(
            image(tx.foliage(1024, 150, leaves, ground=(0.78, 0.80, 0.78), seed=66)), roughness=0.8, specular=0.2
        ),
        "plaster": painted(
            image(tx.marble(512, (0.72, 0.66, 0.56), (0.90, 0.86, 0.78), seed=67)), roughness=0.9, specular=0.1
        ),
        "rug": painted(image(rug), roughness=0.9, specular=0.1),
        "cloth": painted(image(cloth), roughness=0.9, specular=0.1),
        "ball": painted(image(tx.lined_ball(1024, (0.90, 0.40, 0.10), (0.06, 0.05, 0.05), seed=70)), roughness=0.5),
        "globe": painted(image(tx.playball(512, (TEAL, CREAM, NAVY, SAGE), seed=71)), roughness=0.2, coat=0.6),
        "block": painted(image(tx.toy_block(768, BRIGHT, seed=72)), roughness=0.4, specular=0.4),
        "clay": painted(
            image(tx.marble(512, (0.45, 0.21, 0.13), (0.66, 0.38, 0.25), seed=73)), roughness=0.7, specular=0.2
        ),
        "vase": painted(image(tx.tiles(512, 9, (NAVY, TEAL, CREAM, CLARET), seed=74)), roughness=0.2, coat=0.8),
        "leaf0": painted((0.06, 0.20, 0.05), roughness=0.4),
        "leaf1": painted((0.12, 0.28, 0.07), roughness=0.4),
        "leaf2": painted((0.19, 0.34, 0.11), roughness=0.4),
        "copper": metal("Cu", along=0.1, across=0.1),
    }  # fmt: skip
    for number, palette in enumerate(
        [(RUST, CREAM, *CLOTH), (NAVY, SAGE, *BRIGHT), (CREAM, TEAL, *BRIGHT), (OCHRE, RUST, *CLOTH)]
    ):
        surfaces[f"picture{number}"] = painted(
            image(tx.picture(512, palette, seed=80 + number)), roughness=0.5, specular=0.3
        )
    for number, color in enumerate((CLARET, NAVY, OCHRE, SAGE, RUST, TEAL)):
        cover = tx.kilim(
            256, 2, (color, color, *(tuple(k * c for c in color) for k in (0.5, 0.8, 1.2))), seed=90 + number
        )
        surfaces[f"book{number}"] = painted(image(cover), roughness=0.6, specular=0.3)
    return surfaces
