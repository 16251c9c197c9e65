# SPDX-License-Identifier: Apache-2.0
"""What moves, in closed form in time (seconds); the clip lasts 0.4 s.

Every shape is there from frame 0, hidden until it appears, so that the renderer compiles its kernel once.
"""

import numpy as np
from meshes import Parts, box, revolved, rotation, sheet, smooth_profile, sphere, tube

from table.room import TAP

POUR_SECONDS = 0.085  # the tap opens
JACK_SECONDS = 0.085  # the spring is let go
GLASS_BOTTOM = 0.012


def toys(t: float) -> Parts:
    """Rigid motion: a block that slides along an arc and turns, a ball that rolls without slipping."""
    share = t / 0.4
    block_at = (-0.18 + 0.17 * share, -0.24 + 0.03 * np.sin(np.pi * share), 0.055)
    radius, travel = 0.048, 0.26 * share
    rolled = rotation("y", np.rad2deg(travel / radius)) @ rotation("x", 65)
    return {
        "block": (
            box((0.11, 0.11, 0.11), atlas=True).placed(block_at, rotation("z", 20 + 80 * share)),
            "block",
        ),
        "ball": (sphere(radius).placed((-0.40 + travel, -0.345, radius), rolled), "ball"),
    }


def soft_things(t: float) -> Parts:
    """Deformation: a towel that waves on its rod and a jelly that wobbles on its plate."""
    u, v = np.meshgrid(np.linspace(0, 1, 56), np.linspace(0, 1, 72), indexing="ij")
    loose = (1 - v) ** 1.2
    points = np.stack([
        0.62 + 0.29 * (u - 0.5) + 0.03 * loose * np.sin(4 * v + 14 * t),
        0.36 + 0.055 * loose * np.sin(7 * u + 15 * t) + 0.02 * loose * np.sin(11 * v - 18 * t + 3 * u)
        + 0.006 * np.sin(34 * u),
        0.45 + 0.40 * (v - 1) + 0.012 * loose * np.sin(6 * u + 13 * t),
    ], -1)  # fmt: skip
    dome = revolved(smooth_profile([(0, 0), (0.080, 0), (0.078, 0.03), (0.060, 0.075), (0.030, 0.09), (0, 0.092)]))
    squash = 0.24 * np.sin(26 * t) * np.exp(-1.5 * t)
    jelly = dome.vertices * [1 - 0.45 * squash, 1 - 0.45 * squash, 1 + squash]
    high = (dome.vertices[:, 2] / 0.09) ** 2
    jelly[:, 0] += 0.035 * np.sin(21 * t) * high
    jelly[:, 1] += 0.020 * (1 - np.cos(17 * t)) * high
    placed = sheet(jelly.reshape(72, 64, 3), dome.uvs.reshape(72, 64, 2)).placed((-0.40, 0.03, 0.014))
    return {"towel": (sheet(points, np.stack([u * 0.75, v], -1)), "towel"), "jelly": (placed, "jelly")}


def pour(t: float) -> Parts:
    """Emergence: from frame 3 juice runs from the tap; it reaches the glass and its level rises."""
    since = max(t - POUR_SECONDS, 0.0)
    fallen = 1.1 * since + 4.9 * since**2
    level = GLASS_BOTTOM + 0.05 * np.clip((since - 0.12) / 0.2, 0, 1)
    q = np.linspace(0, 1, 40)
    length = min(fallen, TAP[2] - level)
    height = TAP[2] + 0.004 - (length + 0.004) * q
    drop = TAP[2] - height
    path = np.stack(
        [
            TAP[0] + 0.003 * np.sin(70 * drop - 60 * t) * np.clip(drop / 0.1, 0, 1),
            TAP[1] - 0.004 * np.sin(55 * drop - 50 * t) * np.clip(drop / 0.1, 0, 1),
            height,
        ],
        -1,
    )
    radius = (0.0110 - 0.010 * np.clip(drop, 0, 0.3)) * (1 + 0.12 * np.sin(90 * drop - 70 * t))
    if fallen < TAP[2] - level:
        radius = radius * np.sqrt(np.clip((1 - q) / 0.12, 0.01, 1))  # the falling head is round
    stream = tube(path, radius)
    inner = 0.033 + 0.009 * (level - 0.004) / 0.111
    ripple = 0.002 * np.sin(60 * t)
    body = revolved(
        [(0, level - ripple), (inner / 2, level + ripple), (inner - 0.001, level), (0.033, 0.006), (0, 0.006)]
    )
    hidden = (0.0, 0.0, 0.0) if since > 0 else (0.0, 0.0, -0.30)
    filled = (0.0, 0.0, 0.0) if level > GLASS_BOTTOM else (0.0, 0.0, -0.30)
    return {
        "stream": (stream.placed(hidden), "juice"),
        "juice": (body.placed((TAP[0], TAP[1], 0.0)).placed(filled), "juice"),
    }


def jack(t: float) -> Parts:
    """Emergence: from frame 3 a ball on a spring jumps out of its chest, overshoots and sways."""
    since = max(t - JACK_SECONDS, 0.0)
    rise = 1 - np.exp(-9 * since) * np.cos(17 * since)
    centre = np.array([0.21 + 0.05 * np.sin(13 * since) * rise, -0.22, 0.050 + 0.180 * rise])
    radius = 0.043
    q = np.linspace(0, 1, 160)
    foot, top = np.array([0.21, -0.22, 0.006]), centre - [0, 0, 0.8 * radius]
    axis = foot + (top - foot) * q[:, None] + np.stack([(centre[0] - foot[0]) * (q**2 - q), 0 * q, 0 * q], -1)
    turns = 2 * np.pi * 5 * q
    coil = axis + 0.026 * np.stack([np.cos(turns), np.sin(turns), 0 * q], -1)
    head = sphere(radius).placed(centre, rotation("y", 40 * np.sin(13 * since)) @ rotation("x", 50))
    return {"jack": (head, "jack"), "spring": (tube(coil, 0.0045, around=12), "brass")}


def select_dynamic(t: float) -> Parts:
    """Everything that moves, at time ``t``."""
    return toys(t) | soft_things(t) | pour(t) | jack(t)
