# SPDX-License-Identifier: Apache-2.0
"""Procedural textures of the clips, made with numpy alone.

Every function returns sRGB values ``[n, n, 3]`` in 0..1. All but the pictures tile without a seam.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Texture = NDArray[np.float64]
Color = Sequence[float]


def noise(n: int, *, slope: float, seed: int, stretch: float = 1.0) -> NDArray[np.float64]:
    """Periodic ``[n, n]`` noise of spectrum ``1/f**slope``, mean 0, deviation 1; ``stretch`` draws it out."""
    rng = np.random.default_rng(seed)
    row, column = np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n), indexing="ij")
    frequency = np.hypot(row * stretch, column) * n
    gain = np.where(frequency > 0, np.maximum(frequency, 1e-9) ** -slope, 0.0)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(n, n))) * gain).real
    return (field - field.mean()) / field.std()


def mixed(low: Color, high: Color, weight: NDArray[np.float64]) -> Texture:
    """From ``low`` to ``high`` by ``weight`` (clipped to 0..1)."""
    w = np.clip(weight, 0, 1)[..., None]
    return np.asarray(low) * (1 - w) + np.asarray(high) * w


def _unit_grid(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixel centres ``(v, u)`` in 0..1, each ``[n, n]``."""
    centre = (np.arange(n) + 0.5) / n
    v, u = np.meshgrid(centre, centre, indexing="ij")
    return v, u


def wood(n: int, dark: Color, light: Color, *, seed: int, planks: int = 1) -> Texture:
    """Grain along the rows, in ``planks`` boards of differing tint with a dark joint between them."""
    rng = np.random.default_rng(seed)
    grain = noise(n, slope=1.1, seed=seed, stretch=14.0)
    fibre = noise(n, slope=0.35, seed=seed + 1, stretch=40.0)
    figure = np.sin(5.0 * noise(n, slope=1.9, seed=seed + 2, stretch=5.0))
    value = 0.5 + 0.2 * grain + 0.1 * fibre + 0.16 * figure
    height = n // planks
    for board in range(planks):
        rows = slice(board * height, (board + 1) * height)
        value[rows] = np.roll(value[rows], int(rng.integers(n)), axis=1) + rng.uniform(-0.14, 0.14)
        if planks > 1:
            value[board * height : board * height + max(2, n // 256)] = -0.3
    return mixed(dark, light, value) * np.where(value < -0.2, 0.5, 1.0)[..., None]


def tiles(n: int, count: int, palette: Sequence[Color], *, seed: int, grout: Color = (0.78, 0.75, 0.7)) -> Texture:
    """Hand-glazed square tiles: each its own colour and clouding, pillowed edges, pale joints."""
    rng = np.random.default_rng(seed)
    v, u = _unit_grid(n)
    row, column = (v * count).astype(int), (u * count).astype(int)
    base = np.asarray(palette)[rng.integers(len(palette), size=(count, count))]
    base = np.clip(base * rng.uniform(0.72, 1.22, (count, count, 1)), 0, 1)
    cloud = 1 + 0.10 * noise(n, slope=1.3, seed=seed + 1)
    tilt = rng.uniform(-0.3, 0.3, (2, count, count))[:, row, column]
    y, x = v * count % 1 - 0.5, u * count % 1 - 0.5
    color = base[row, column] * (cloud + tilt[0] * x + tilt[1] * y)[..., None]
    joint = np.maximum(np.abs(x), np.abs(y)) > 0.465
    color[joint] = np.asarray(grout) * (0.9 + 0.08 * noise(n, slope=0.5, seed=seed + 2))[joint][:, None]
    return np.clip(color, 0, 1)


def terrazzo(n: int, chips: int, palette: Sequence[Color], *, base: Color, seed: int) -> Texture:
    """Irregular chips of stone in cement: the gaps are where two cells of a periodic Voronoi diagram meet."""
    rng = np.random.default_rng(seed)
    sites = rng.uniform(size=(chips, 2))
    tree = cKDTree(sites, boxsize=1.0)
    v, u = _unit_grid(n)
    warp = 0.15 / np.sqrt(chips) * np.stack([noise(n, slope=1.4, seed=seed + k) for k in (1, 2)], -1)
    distance, cell = tree.query(np.mod(np.stack([v, u], -1) + warp, 1.0), k=2)
    shade = rng.uniform(0.75, 1.15, (chips, 1))
    color = np.asarray(palette)[rng.integers(len(palette), size=chips)] * shade
    gap = (distance[..., 1] - distance[..., 0]) * np.sqrt(chips) < rng.uniform(0.05, 0.55, chips)[cell[..., 0]]
    out = np.where(gap[..., None], np.asarray(base), color[cell[..., 0]])
    return np.clip(out * (1 + 0.05 * noise(n, slope=0.6, seed=seed + 3))[..., None], 0, 1)


def kilim(n: int, count: int, palette: Sequence[Color], *, seed: int) -> Texture:
    """A woven cloth: nested stepped diamonds whose colours differ by cell, with the threads visible."""
    rng = np.random.default_rng(seed)
    v, u = _unit_grid(n)
    row, column = (v * count).astype(int), (u * count).astype(int)
    steps = 12
    y = np.abs(np.floor((v * count % 1) * steps) + 0.5 - steps / 2)
    x = np.abs(np.floor((u * count % 1) * steps) + 0.5 - steps / 2)
    ring = np.minimum((x + y) // 2.5, 3).astype(int)
    pick = np.argsort(rng.uniform(size=(count, count, len(palette))), axis=-1)[..., :4]
    color = np.asarray(palette)[pick[row, column, ring]]
    threads = np.sin(2 * np.pi * 110 * u) * np.sin(2 * np.pi * 110 * v)
    return np.clip(color * (0.93 + 0.06 * threads + 0.07 * noise(n, slope=0.8, seed=seed + 1))[..., None], 0, 1)


def foliage(n: int, leaves: int, palette: Sequence[Color], *, ground: Color, seed: int) -> Texture:
    """Wallpaper of leaves strewn at random, each with a midrib; later leaves lie over earlier ones."""
    rng = np.random.default_rng(seed)
    out = np.broadcast_to(np.asarray(ground), (n, n, 3)) * (1 + 0.05 * noise(n, slope=1.2, seed=seed))[..., None]
    v, u = _unit_grid(n)
    for _ in range(leaves):
        cv, cu, angle, length = *rng.uniform(size=2), rng.uniform(0, 2 * np.pi), rng.uniform(0.05, 0.11)
        y, x = (v - cv + 0.5) % 1 - 0.5, (u - cu + 0.5) % 1 - 0.5
        along = (x * np.cos(angle) + y * np.sin(angle)) / length
        across = (y * np.cos(angle) - x * np.sin(angle)) / length
        width = 0.34 * (1 - along**2) * (1 - 0.35 * along)
        inside = (np.abs(along) < 1) & (np.abs(across) < width)
        color = np.asarray(palette[rng.integers(len(palette))]) * rng.uniform(0.8, 1.15)
        veins = np.abs((along * 6 - np.abs(across) * 5) % 1 - 0.5) < 0.09
        ribs = 1 + 0.35 * (veins | (np.abs(across) < 0.03))
        out[inside] = (color * ribs[..., None])[inside]
    return np.clip(out, 0, 1)


def marble(n: int, low: Color, high: Color, *, seed: int, veins: float = 3.0) -> Texture:
    """Veined stone or glaze: a sine of warped noise."""
    warp = noise(n, slope=1.7, seed=seed)
    vein = np.abs(np.sin(veins * warp + 0.4 * noise(n, slope=1.0, seed=seed + 1))) ** 0.6
    return mixed(low, high, vein + 0.08 * noise(n, slope=0.7, seed=seed + 2))


def picture(n: int, palette: Sequence[Color], *, seed: int) -> Texture:
    """An abstract painting: overlapping discs, bars and washes with a canvas grain. Does not tile."""
    rng = np.random.default_rng(seed)
    colors = np.asarray(palette)
    v, u = _unit_grid(n)
    wash = noise(n, slope=1.8, seed=seed)
    out = mixed(colors[0], colors[1], 0.5 + 0.35 * wash + 0.5 * (v - 0.5))
    for _ in range(16):
        cv, cu, size, angle = rng.uniform(), rng.uniform(), rng.uniform(0.05, 0.2), rng.uniform(0, np.pi)
        if rng.uniform() < 0.55:
            shape = np.hypot(u - cu, v - cv) < size
        else:
            along = (u - cu) * np.cos(angle) + (v - cv) * np.sin(angle)
            across = (v - cv) * np.cos(angle) - (u - cu) * np.sin(angle)
            shape = (np.abs(along) < 2.5 * size) & (np.abs(across) < 0.25 * size)
        opacity = rng.uniform(0.65, 1.0)
        out[shape] = (1 - opacity) * out[shape] + opacity * colors[rng.integers(len(colors))]
    return np.clip(out * (1 + 0.06 * noise(n, slope=0.5, seed=seed + 1))[..., None], 0, 1)


def toy_block(n: int, palette: Sequence[Color], *, seed: int) -> Texture:
    """Atlas of six faces (3 x 2), each with a border and an emblem, for ``meshes.box(atlas=True)``."""
    v, u = _unit_grid(n)
    cell = (v * 2).astype(int) * 3 + (u * 3).astype(int)
    y, x = v * 2 % 1 * 2 - 1, u * 3 % 1 * 2 - 1
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    emblem = np.stack(
        [
            radius < 0.38 + 0.22 * np.cos(5 * angle),
            np.abs(radius - 0.45) < 0.15,
            (np.abs(x) + np.abs(y) < 0.65) & (np.abs(x) + np.abs(y) > 0.25),
            np.minimum(np.abs(x), np.abs(y)) < 0.16,
            np.abs((x + y) * 3 % 1 - 0.5) < 0.22,
            (np.floor((x + 1) * 2.5) + np.floor((y + 1) * 2.5)) % 2 == 0,
        ]
    )
    colors = np.asarray(palette)
    emblem &= np.maximum(np.abs(x), np.abs(y)) < 0.7
    border = np.maximum(np.abs(x), np.abs(y)) > 0.84
    out = colors[cell % len(colors)]
    shape = np.take_along_axis(emblem, cell[None], 0)[0]
    out = np.where(shape[..., None], colors[(cell + 3) % len(colors)], out)
    out = np.where(border[..., None], (0.93, 0.88, 0.76), out)
    return np.clip(out * (1 + 0.05 * noise(n, slope=0.9, seed=seed))[..., None], 0, 1)


def playball(n: int, palette: Sequence[Color], *, seed: int) -> Texture:
    """Gores of differing colour around the axis (u) with strewn dots, so that turning shows."""
    rng = np.random.default_rng(seed)
    colors = np.asarray(palette)
    v, u = _unit_grid(n)
    out = colors[(u * 8).astype(int) % len(colors)]
    for _ in range(40):
        cu, cv = rng.uniform(), rng.uniform(0.12, 0.88)
        du = ((u - cu + 0.5) % 1 - 0.5) * 2 * np.sin(np.pi * cv)
        dot = np.hypot(du, v - cv) < rng.uniform(0.02, 0.05)
        out = np.where(dot[..., None], colors[rng.integers(len(colors))], out)
    return np.clip(out * (1 + 0.04 * noise(n, slope=0.9, seed=seed))[..., None], 0, 1)


def lined_ball(n: int, color: Color, line: Color, *, seed: int) -> Texture:
    """A ball of one colour with dark lines: two great circles and two small ones. Not periodic in v."""
    v, u = _unit_grid(n)
    x, y = np.cos(2 * np.pi * u) * np.sin(np.pi * v), np.sin(2 * np.pi * u) * np.sin(np.pi * v)
    z = np.cos(np.pi * v)
    width = 0.055
    lines = (np.abs(x) < width) | (np.abs(z) < width) | (np.abs(np.abs(y) - 0.62 - 0.12 * z**2) < width * 0.8)
    out = np.where(lines[..., None], line, color)
    return np.clip(out * (1 + 0.06 * noise(n, slope=0.6, seed=seed))[..., None], 0, 1)


def tartan(n: int, palette: Sequence[Color], *, across: int, along: int, seed: int) -> Texture:
    """A woven cloth of stripes: ``along`` bands over v and ``across`` over u, each of the palette's colours in turn."""
    v, u = _unit_grid(n)
    colors = np.asarray(palette)
    rng = np.random.default_rng(seed)
    layers = []
    for count, at in ((along, v), (across, u)):
        if count:
            edges = np.sort(rng.uniform(-0.25, 0.25, 3 * count) + np.arange(3 * count)) / (3 * count)
            band = np.searchsorted(edges, at.ravel()).reshape(at.shape) - 1
            layers.append(colors[band % len(colors)])
    weave = np.sin(2 * np.pi * 90 * u) * np.sin(2 * np.pi * 90 * v)
    out = np.mean(layers, axis=0)
    return np.clip(out * (0.95 + 0.05 * weave + 0.06 * noise(n, slope=0.9, seed=seed + 1))[..., None], 0, 1)


def face(n: int, skin: Color, hair: Color, *, seed: int) -> Texture:
    """A head around its axis: the face's middle is at u = 0.75 (which looks along -y), v goes up from the chin."""
    v, u = _unit_grid(n)
    out = np.asarray(skin) * (1 + 0.05 * noise(n, slope=1.5, seed=seed))[..., None]
    x, y = ((u - 0.75 + 0.5) % 1 - 0.5) * 2 * np.pi, (v - 0.5) * np.pi
    cheeks = np.exp(-((np.abs(x) - 0.55) ** 2 + (y + 0.2) ** 2) / 0.05)
    out = out * (1 + cheeks[..., None] * np.array([0.08, -0.10, -0.10]))
    strands = np.sin(60 * x + 6 * noise(n, slope=1.6, seed=seed + 1))
    fringe = 0.55 + 0.08 * np.sin(7 * x)
    covered = np.where(np.abs(x) < 1.15, y > fringe, y > -0.55)
    out = np.where(covered[..., None], np.asarray(hair) * (1 + 0.25 * strands)[..., None], out)
    white = ((np.abs(x) - 0.36) / 0.17) ** 2 + ((y - 0.12) / 0.09) ** 2 < 1
    iris = ((np.abs(x) - 0.36) / 0.08) ** 2 + ((y - 0.12) / 0.085) ** 2 < 1
    brow = (np.abs(np.abs(x) - 0.36) < 0.2) & (np.abs(y - 0.30) < 0.035)
    mouth = ((x / 0.28) ** 2 + ((y + 0.48 - 0.25 * x**2) / 0.055) ** 2) < 1
    nose = (np.abs(x) < 0.09) & (np.abs(y + 0.10) < 0.06)
    out = np.where(white[..., None], (0.94, 0.93, 0.90), out)
    out = np.where(iris[..., None], (0.12, 0.10, 0.08), out)
    out = np.where(brow[..., None], np.asarray(hair) * 0.8, out)
    out = np.where(mouth[..., None], (0.62, 0.16, 0.16), out)
    out = np.where(nose[..., None], np.asarray(skin) * 0.8, out)
    return np.clip(out, 0, 1)
