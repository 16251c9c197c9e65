# SPDX-License-Identifier: Apache-2.0
"""A person-like figure: tapered capsules between joints, arms and legs placed by where hands and feet are.

Its own axes: x to its left, -y ahead, z up; a heading of 0 degrees looks along -y, towards the cameras.
"""

from dataclasses import dataclass

import numpy as np
from meshes import Array, Mesh, Parts, revolved, rotation, sheet, smooth_profile

UPPER_ARM, FOREARM, THIGH, SHIN = 0.28, 0.26, 0.42, 0.43
SHOULDER = np.array([0.185, 0.0, 0.47])  # from the hips, upright; its mirror image is the right one
HIP = np.array([0.095, 0.0, -0.02])
RIGHT, LEFT = 0, 1


@dataclass(frozen=True)
class Pose:
    """Hips ``[3]`` (metres), headings in degrees, lean ahead in degrees, wrists and ankles ``[2, 3]`` (right, left)."""

    hips: Array
    hips_heading: float
    chest_heading: float
    head_heading: float
    lean: float
    wrists: Array
    ankles: Array
    foot_headings: tuple[float, float]


@dataclass(frozen=True)
class Clothes:
    """Names of surfaces."""

    shirt: str
    sleeves: str
    trousers: str
    shoes: str
    head: str
    skin: str


def chest_frame(hips: Array, heading: float, lean: float) -> tuple[Array, Array]:
    """Origin and rotation of the chest's axes: ``origin + rotation @ point`` for a point measured from the hips."""
    return np.asarray(hips, float), rotation("z", heading) @ rotation("x", lean)


def bent_limb(root: Array, end: Array, lengths: tuple[float, float], towards: Array) -> tuple[Array, Array]:
    """Middle joint and end of a two-bone limb that bends ``towards`` a direction; an end out of reach comes nearer."""
    upper, lower = lengths
    reach = end - root
    distance = float(np.linalg.norm(reach))
    axis = reach / distance
    distance = float(np.clip(distance, abs(upper - lower) + 0.02, (upper + lower) * 0.995))
    along = (upper**2 - lower**2 + distance**2) / (2 * distance)
    side = towards - axis * (towards @ axis)
    side = side / np.linalg.norm(side)
    return root + axis * along + side * np.sqrt(upper**2 - along**2), root + axis * distance


def capsule(a: Array, b: Array, radii: tuple[float, float], front: Array, *, bulge: float = 0.0) -> Mesh:
    """A limb from ``a`` to ``b`` with round ends; ``front`` fixes how its texture lies around the axis."""
    length = float(np.linalg.norm(b - a))
    polar = np.linspace(0, np.pi / 2, 10)
    q = np.linspace(0, 1, 16)[1:-1]
    foot = np.stack([radii[0] * np.sin(polar), -radii[0] * np.cos(polar)], -1)
    shaft = np.stack([radii[0] + (radii[1] - radii[0]) * q + bulge * np.sin(np.pi * q), length * q], -1)
    top = np.stack([radii[1] * np.cos(polar), length + radii[1] * np.sin(polar)], -1)
    mesh = revolved(np.concatenate([foot, shaft, top]), around=32)
    axis = (b - a) / length
    across = front - axis * (front @ axis)
    across = across / np.linalg.norm(across)
    return mesh.placed(a, np.stack([across, np.cross(axis, across), axis], -1))


def figure(pose: Pose, clothes: Clothes, *, name: str) -> Parts:
    """The figure in a pose."""
    hips_turn = rotation("z", pose.hips_heading)
    chest_at, chest_turn = chest_frame(pose.hips, pose.chest_heading, pose.lean)
    neck = chest_at + chest_turn @ [0, 0, 0.53]
    parts: Parts = {
        f"{name}-trunk": (_trunk(pose, chest_turn), clothes.shirt),
        f"{name}-pelvis": (_pelvis().placed(pose.hips, hips_turn), clothes.trousers),
        f"{name}-neck": (
            capsule(neck - [0, 0, 0.05], neck + np.array([0, 0, 0.06]), (0.055, 0.05), hips_turn[:, 0]),
            clothes.skin,
        ),
        f"{name}-head": (
            _head().placed(neck + np.array([0, 0, 0.155]), rotation("z", pose.head_heading)),
            clothes.head,
        ),
    }
    for side, mirror in ((RIGHT, -1.0), (LEFT, 1.0)):
        label, flip = f"{name}-{'right' if side == RIGHT else 'left'}", np.array([mirror, 1, 1])
        shoulder = chest_at + chest_turn @ (SHOULDER * flip)
        elbow, wrist = bent_limb(
            shoulder, pose.wrists[side], (UPPER_ARM, FOREARM), chest_turn @ [0.5 * mirror, 0.6, -0.9]
        )
        out = chest_turn @ [mirror, 0.3, 0]
        hand = wrist + (wrist - elbow) / FOREARM * 0.09
        hip = pose.hips + hips_turn @ (HIP * flip)
        turn = rotation("z", pose.foot_headings[side])
        knee, ankle = bent_limb(hip, pose.ankles[side], (THIGH, SHIN), hips_turn @ [0.1 * mirror, -1, 0])
        parts |= {
            f"{label}-upper-arm": (capsule(shoulder, elbow, (0.066, 0.047), out), clothes.sleeves),
            f"{label}-forearm": (capsule(elbow, wrist, (0.048, 0.036), out, bulge=0.006), clothes.sleeves),
            f"{label}-hand": (capsule(wrist, hand, (0.032, 0.036), out, bulge=0.008), clothes.skin),
            f"{label}-thigh": (capsule(hip, knee, (0.092, 0.062), hips_turn[:, 0]), clothes.trousers),
            f"{label}-shin": (capsule(knee, ankle, (0.062, 0.044), hips_turn[:, 0], bulge=0.01), clothes.trousers),
            f"{label}-foot": (
                capsule(
                    ankle + turn @ [0, 0.05, -0.035], ankle + turn @ [0, -0.14, -0.045], (0.045, 0.038), turn[:, 0]
                ),
                clothes.shoes,
            ),
        }
    return parts


def _trunk(pose: Pose, chest_turn: Array) -> Mesh:
    """From the waist to the shoulders; what is lower turns with the hips, what is higher with the chest."""
    knots = [(0.0, -0.03), (0.125, -0.03), (0.128, 0.05), (0.120, 0.16), (0.150, 0.33), (0.165, 0.42), (0.13, 0.49),
             (0.06, 0.535), (0.0, 0.54)]  # fmt: skip
    line = smooth_profile(knots, samples=48)
    share = np.clip(line[:, 1] / 0.35, 0, 1)
    share = share * share * (3 - 2 * share)
    upright = revolved(line, around=64)
    grid = upright.vertices.reshape(64, 48, 3) * [1.22, 0.82, 1.0]
    lower = grid @ rotation("z", pose.hips_heading).T
    upper = grid @ chest_turn.T
    return sheet(lower + (upper - lower) * share[None, :, None] + pose.hips, upright.uvs.reshape(64, 48, 2))


def _pelvis() -> Mesh:
    polar = np.linspace(0, np.pi, 32)
    ball = revolved(np.stack([0.12 * np.sin(polar), -0.11 * np.cos(polar)], -1), around=48)
    return sheet((ball.vertices * [1.3, 1.0, 1.0]).reshape(48, 32, 3), ball.uvs.reshape(48, 32, 2))


def _head() -> Mesh:
    polar = np.linspace(0, np.pi, 40)
    return revolved(np.stack([0.105 * np.sin(polar), -0.13 * np.cos(polar)], -1), around=64)
