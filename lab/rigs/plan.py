# SPDX-License-Identifier: Apache-2.0
"""Writes the rays that ``lab/clip/rays.py`` renders: ``python -m lab.rigs.plan build/rigs``."""

import argparse
from pathlib import Path

import numpy as np

from lab.rigs.rig import STEP_SECONDS, corner_directions, traced


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder / "rays"
    folder.mkdir(parents=True, exist_ok=True)
    for name, wanted in traced().items():
        np.savez_compressed(
            folder / f"{name}.npz",
            eye=wanted.camera.camera.center.numpy(),
            corners=corner_directions(wanted.camera),
            seconds=np.array(wanted.steps) * STEP_SECONDS,
        )
    print(f"{sum(len(wanted.steps) for wanted in traced().values())} pictures to render")


if __name__ == "__main__":
    main()
