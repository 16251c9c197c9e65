# SPDX-License-Identifier: Apache-2.0
"""Results made by hand, with the numbers that a test asks about."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from structgstream_studies.experiments.present import present_configs
from structgstream_studies.experiments.results import Result

CAPTURE: Mapping[str, Any] = {
    "name": "ring",
    "fingerprint": "0123456789abcdef",
    "frames": 3,
    "start": 0,
    "every": 1,
    "scale": 1.0,
    "near": None,
    "fps": 30.0,
    "sizes": [[64, 48]],
    "training_cameras": 5,
    "held_out": ["a", "b"],
    "scored": ["a", "b"],
}


def outcome(
    key: str,
    seed: int = 0,
    *,
    psnr: float | None = 30.0,
    mean: Mapping[str, float | None] | None = None,
    stream: Mapping[str, Any] | None = None,
    frames: Sequence[Mapping[str, Any]] = (),
    capture: Mapping[str, Any] | None = None,
) -> Result:
    """A result of ``key`` on a capture called ring, unless ``capture`` says otherwise."""
    machine = {"commit": "abc1234", "cpu": "a processor", "gpu": None, "threads": 1, "cores": 4, "torch": "2.0"}
    return Result(
        identity={
            "key": key,
            "method": "m",
            "seed": seed,
            "config": present(key),
            "capture": {**CAPTURE, **(capture or {})},
        },
        mean={"psnr": psnr, **(mean or {})},
        cameras={},
        stream=dict(stream or {}),
        frames=list(frames) or [{"index": i, "psnr": psnr} for i in range(3)],
        environment=machine,
        trained_by=machine,
    )


def present(key: str) -> Mapping[str, Any]:
    """The configuration that a row has today, as results record it; without its seed."""
    nested: dict[str, Any] = {}
    for path, value in present_configs().get(key, {}).get("rig", {}).items():
        *folders, name = path.split(".")
        place = nested
        for folder in folders:
            place = place.setdefault(folder, {})
        place[name] = value
    return nested


def outcomes(key: str, psnrs: Iterable[float]) -> list[Result]:
    """Results of ``key`` with the seeds 0, 1, ..."""
    return [outcome(key, seed, psnr=psnr) for seed, psnr in enumerate(psnrs)]
