# SPDX-License-Identifier: Apache-2.0
"""A cloth that falls over a globe on a stool: particles at fixed distances (position-based dynamics in small steps).

Computed anew from the moment it is let go for every time that is asked for, so that any frame can be made alone.
"""

import numpy as np
from meshes import Array, Mesh, rotation, sheet

SIDE_METRES, COUNT = 1.05, 43
SECONDS_A_STEP = 1 / 1500
LET_GO_SECONDS = -0.14  # before frame 0, so that it is in full fall there
STOOL_RADIUS, STOOL_TOP = 0.21, 0.52
GLOBE_RADIUS = 0.15
SKIN = 0.012  # the cloth stays this far from what it lies on
FRICTION = 0.02  # share of the sliding that is lost in a step of contact


def fallen_cloth(t: float, *, over: tuple[float, float]) -> Mesh:
    """The cloth at time ``t``; ``over`` is where the stool stands."""
    now = _let_go()
    before = now - _first_velocity(now) * SECONDS_A_STEP
    links = _links()
    for _ in range(round((t - LET_GO_SECONDS) / SECONDS_A_STEP)):
        velocity = (now - before) / SECONDS_A_STEP
        velocity = velocity + SECONDS_A_STEP * (np.array([0, 0, -9.81]) + _drag(now, velocity))
        before, now = now, now + velocity * SECONDS_A_STEP
        for a, b, length, stiffness in links:
            _satisfy(now.reshape(-1, 3), a, b, length, stiffness)
        now = _outside(now, before)
    u, v = np.meshgrid(np.linspace(0, 1, COUNT), np.linspace(0, 1, COUNT), indexing="ij")
    return sheet(now + np.array([*over, 0.0]), np.stack([u, v], -1))


def _let_go() -> Array:
    """In waves along one side, tilted; ``[COUNT, COUNT, 3]`` about the stool's axis."""
    s = np.linspace(-0.5, 0.5, COUNT) * SIDE_METRES
    height = 0.035 * np.sin(13 * s + 0.8) + 0.018 * np.sin(29 * s)
    slope = np.gradient(height, s)
    x = np.concatenate([[0], np.cumsum(np.sqrt(np.clip(1 - ((slope[1:] + slope[:-1]) / 2) ** 2, 0.2, 1)) * np.diff(s))])
    x = x - x[-1] / 2
    flat = np.stack(np.broadcast_arrays(x[:, None], s[None, :], height[:, None]), -1)
    return flat @ (rotation("z", 38) @ rotation("x", 24)).T + np.array([0.05, 0, 1.42])


def _first_velocity(points: Array) -> Array:
    """Down and a little to the left, turning, one side ahead, in metres a second."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([-0.35 - 1.2 * y, 1.2 * x, -1.0 - 0.9 * x], -1)


def _links() -> list[tuple[Array, Array, Array, float]]:
    """Pairs of particles with their distance and stiffness, in batches in which no particle occurs twice."""
    number = np.arange(COUNT * COUNT).reshape(COUNT, COUNT)
    spacing = SIDE_METRES / (COUNT - 1)
    out = []
    for rows, columns, stiffness in ((1, 0, 1.0), (0, 1, 1.0), (1, 1, 0.12), (1, -1, 0.12), (2, 0, 0.01), (0, 2, 0.01)):
        if columns < 0:
            a, b = number[: COUNT - rows, -columns:], number[rows:, :columns]
        else:
            a, b = number[: COUNT - rows, : COUNT - columns], number[rows:, columns:]
        step = max(rows, abs(columns))
        i = np.arange(a.shape[0])[:, None] + 0 * a
        j = np.arange(a.shape[1])[None, :] + 0 * a
        phase = ((i if rows else j) // step) % 2
        for even in (0, 1):
            chosen = phase == even
            length = np.full(int(chosen.sum()), spacing * float(np.hypot(rows, columns)))
            out.append((a[chosen], b[chosen], length, stiffness))
    return out


def _satisfy(points: Array, a: Array, b: Array, length: Array, stiffness: float) -> None:
    """Moves both ends of every link towards its length, in place."""
    between = points[b] - points[a]
    distance = np.linalg.norm(between, axis=1)
    move = (0.5 * stiffness * (1 - length / distance))[:, None] * between
    points[a] += move
    points[b] -= move


def _drag(points: Array, velocity: Array) -> Array:
    """Air resists motion across the cloth, not along it."""
    normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12
    across = (velocity * normal).sum(-1, keepdims=True)
    return -0.9 * across * np.abs(across) * normal - 0.3 * velocity


def _outside(points: Array, before: Array) -> Array:
    """Out of globe, stool and floor, with friction where there is contact."""
    out = points.copy()
    centre = np.array([0, 0, STOOL_TOP + GLOBE_RADIUS - 0.01])
    away = out - centre
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    inside = distance < GLOBE_RADIUS + SKIN
    out = np.where(inside, centre + away / distance * (GLOBE_RADIUS + SKIN), out)
    touching = inside[..., 0]

    radius = np.hypot(out[..., 0], out[..., 1])
    under = STOOL_TOP + SKIN - out[..., 2]
    beside = STOOL_RADIUS + SKIN - radius
    hit = (under > 0) & (beside > 0)
    lifted = hit & (under < beside)
    pushed = hit & ~lifted
    out[..., 2] = np.where(lifted, STOOL_TOP + SKIN, out[..., 2])
    scale = np.where(pushed, (STOOL_RADIUS + SKIN) / np.maximum(radius, 1e-6), 1.0)
    out[..., :2] *= scale[..., None]

    low = out[..., 2] < SKIN
    out[..., 2] = np.maximum(out[..., 2], SKIN)
    touching |= hit | low
    return np.where(touching[..., None], out - FRICTION * (out - before), out)
