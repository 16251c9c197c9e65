# SPDX-License-Identifier: Apache-2.0
"""What moves, as a function of time (seconds); the clip lasts 0.4 s.

One figure turns and throws a ball to the floor, another runs in through the left border to where it bounces up, and a
cloth falls over a globe.
"""

from collections.abc import Sequence

import numpy as np
from meshes import Array, Parts, rotation, sphere
from scipy.interpolate import CubicSpline, PchipInterpolator

from throw.cloth import fallen_cloth
from throw.figure import LEFT, RIGHT, Clothes, Pose, chest_frame, figure
from throw.room import STOOL

BALL_RADIUS = 0.12
THROWN_SECONDS, BOUNCED_SECONDS, CAUGHT_SECONDS = 2 / 30, 8 / 30, 11 / 30
CAUGHT_AT = (-0.33, -0.86)
RESTITUTION = 0.8
GRAVITY = 9.81
THROWER = Clothes("argyle", "argyle-sleeve", "denim", "shoe-red", "head-dark", "skin-dark")
CATCHER = Clothes("hoops", "hoops-sleeve", "checks", "shoe-blue", "head-fair", "skin-fair")


def _through(times: Sequence[float], points: Sequence[Sequence[float]], t: float) -> Array:
    return CubicSpline(times, np.asarray(points, float))(t)


def _headings(t: float) -> tuple[float, float, float]:
    """The thrower's hips, chest and head, in degrees: he turns by 155 degrees, the chest ahead of the hips."""
    times = [0.0, 0.0667, 0.15, 0.25, 0.4]
    hips = PchipInterpolator(times, [15.0, -30.0, -78.0, -112.0, -140.0])
    chest = PchipInterpolator(times, [18.0, -38.0, -95.0, -128.0, -152.0])
    head = PchipInterpolator(times, [-15.0, -42.0, -62.0, -80.0, -108.0])
    return float(hips(t)), float(chest(t)), float(head(t))


def thrower(t: float) -> Pose:
    """He stands on his left foot and turns about it; the right leg swings around."""
    hips_heading, chest_heading, head_heading = _headings(t)
    turn = rotation("z", hips_heading)
    pivot = np.array([1.22, -0.10, 0.075])
    hips = pivot + turn @ [-0.10, 0.0, 0.0] + [0, 0, 0.79 + 0.015 * np.sin(8 * t)]
    lean = float(np.interp(t, [0, 0.0667, 0.2, 0.4], [-4, 10, 18, 12]))
    at, chest_turn = chest_frame(hips, chest_heading, lean)
    beats = [0.0, 0.0667, 0.13, 0.2, 0.3, 0.4]
    right = [(-0.52, 0.06, 0.52), (-0.40, -0.40, 0.36), (-0.18, -0.48, 0.22), (0.0, -0.46, 0.12), (0.10, -0.40, 0.06),
             (0.12, -0.36, 0.06)]  # fmt: skip
    left = [(0.34, -0.40, 0.40), (0.48, -0.22, 0.28), (0.52, 0.0, 0.18), (0.50, 0.14, 0.16), (0.46, 0.22, 0.26),
            (0.44, 0.20, 0.36)]  # fmt: skip
    wrists = np.stack([at + chest_turn @ _through(beats, side, t) for side in (right, left)])
    swing = np.sin(np.pi * min(t / 0.36, 1.0))
    right_foot = pivot + turn @ [-0.27, 0.16 - 0.30 * t / 0.4, 0.0] + [0, 0, 0.02 + 0.16 * swing]
    ankles = np.stack([right_foot, pivot])
    return Pose(
        hips, hips_heading, chest_heading, head_heading, lean, wrists, ankles, (hips_heading - 15, hips_heading)
    )


def catcher(t: float) -> Pose:
    """He runs to the right at 3.5 m/s, stooping, and stretches both arms towards the ball."""
    heading = 74.0
    turn = rotation("z", heading)
    stride = 2 * np.pi * (t / 0.56) + 2.2
    hips = np.array([-1.00 - 3.5 * (CAUGHT_SECONDS - t), -0.92, 0.79 - 0.17 * t + 0.02 * np.cos(2 * stride)])
    lean = 14.0 + 65.0 * t
    at, chest_turn = chest_frame(hips, heading, lean)
    share = float(np.clip(t / 0.27, 0, 1))
    share = share * share * (3 - 2 * share)
    swing = 0.28 * np.sin(stride)
    ankles, wrists = [], []
    catch = ball_centre(CAUGHT_SECONDS)
    for side, mirror in ((RIGHT, -1.0), (LEFT, 1.0)):
        phase = stride + (np.pi if side == LEFT else 0.0)
        foot = np.array([0.09 * mirror, -0.36 * np.sin(phase), 0.09 + 0.2 * max(0.0, float(np.cos(phase)))])
        ankles.append([hips[0], hips[1], 0.0] + turn @ foot)
        pumping = at + chest_turn @ np.array([0.27 * mirror, -0.16 - mirror * swing, 0.20])
        out = turn @ np.array([(BALL_RADIUS + 0.025) * mirror, 0.10, 0.0])
        reaching = catch + out - [3.5 * (CAUGHT_SECONDS - t), 0, 0]
        wrists.append(pumping + share * (reaching - pumping))
    return Pose(hips, heading, heading, heading + 8, lean, np.stack(wrists), np.stack(ankles), (heading, heading))


def _held_at(t: float) -> Array:
    """The ball's centre while it is in the thrower's right hand, on the side to which he faces."""
    pose = thrower(t)
    ahead = rotation("z", pose.chest_heading - 20) @ [0, -1, 0]
    return pose.wrists[RIGHT] + 0.13 * ahead + [0, 0, 0.06]


def ball_centre(t: float) -> Array:
    """In the hand, in free flight down to the floor, and up again to where it is caught."""
    if t <= THROWN_SECONDS:
        return _held_at(t)
    start = _held_at(THROWN_SECONDS)
    share = (t - THROWN_SECONDS) / (CAUGHT_SECONDS - THROWN_SECONDS)
    across = start[:2] + share * (np.array(CAUGHT_AT) - start[:2])
    fall = BOUNCED_SECONDS - THROWN_SECONDS
    down = (BALL_RADIUS - start[2]) / fall + GRAVITY * fall / 2  # upward speed at the start
    if t <= BOUNCED_SECONDS:
        since = t - THROWN_SECONDS
        return np.array([*across, start[2] + down * since - GRAVITY * since**2 / 2])
    up, since = -RESTITUTION * (down - GRAVITY * fall), t - BOUNCED_SECONDS
    return np.array([*across, BALL_RADIUS + up * since - GRAVITY * since**2 / 2])


def ball(t: float) -> Parts:
    """It spins backward in flight, at one and a half turns a second."""
    spin = rotation("z", -45) @ rotation("x", 30 + 540 * t) @ rotation("y", 35)
    return {"ball": (sphere(BALL_RADIUS).placed(ball_centre(t), spin), "ball")}


def select_dynamic(t: float) -> Parts:
    """Everything that moves, at time ``t``."""
    cloth: Parts = {"cloth": (fallen_cloth(t, over=STOOL), "cloth")}
    return figure(thrower(t), THROWER, name="thrower") | figure(catcher(t), CATCHER, name="catcher") | ball(t) | cloth
