# SPDX-License-Identifier: Apache-2.0
"""The result of an experiment as a JSON file, with everything that documents need.

``identity`` (method, configuration, seed, capture with its fingerprint) decides whether a result can be reused; the
commit and the machine are stored beside it, and scores are those of ``evaluate``.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from structgstream.atomic_files import atomic_write
from structgstream.errors import StorageError

if TYPE_CHECKING:
    from structgstream.evaluation.report import Report

FRAME_KEYS_OF_LOG = ("total_seconds", "cpu_seconds", "train_psnr", "spawned", "pruned")


@dataclass(frozen=True)
class Result:
    """The result of an experiment.

    Args:
        identity: of the experiment (see the module).
        mean: the mean of each score over frames and held-out cameras.
        cameras: camera name to its means.
        stream: facts of the file.
        frames: one entry for each frame: scores, bytes, counts, seconds.
        environment: commit and machine of the evaluation.
        trained_by: commit and machine of the training.
    """

    identity: Mapping[str, Any]
    mean: Mapping[str, Any]
    cameras: Mapping[str, Any]
    stream: Mapping[str, Any]
    frames: list[Mapping[str, Any]]
    environment: Mapping[str, Any]
    trained_by: Mapping[str, Any]

    @property
    def key(self) -> str:
        """The variant's or method's key."""
        return self.identity["key"]

    @property
    def seed(self) -> int:
        """The random seed."""
        return self.identity["seed"]

    @property
    def capture(self) -> str:
        """Name of the capture."""
        return self.identity["capture"]["name"]


def result_of(report: "Report", *, identity: Mapping[str, Any], trained_by: Mapping[str, Any]) -> Result:
    """The result of an evaluation; details by camera and stage are averaged or left out."""
    from structgstream.evaluation.report import as_json

    content = as_json(report)
    frames = []
    for frame in content["frames"]:
        log = frame.pop("log")
        del frame["cameras"]
        frames.append(frame | {key: log[key] for key in FRAME_KEYS_OF_LOG if key in log})
    stream = {key: value for key, value in content["stream"].items() if key not in ("metadata", "config")}
    # Which scores are missing is of the result; where this machine would have looked for them is not.
    stream["not_available"] = sorted(stream.get("not_available", ()))
    return Result(
        identity=identity,
        mean=content["mean"] | _online_means(frames),
        cameras=content["cameras"],
        stream=stream,
        frames=frames,
        environment=content["environment"],
        trained_by=trained_by,
    )


def _online_means(frames: list[dict[str, Any]]) -> dict[str, float | None]:
    """Means over the frames after frame 0."""
    online = [frame for frame in frames if frame["index"] > 0]

    def mean(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if known else None

    return {
        "online_bytes": mean([frame["bytes"] for frame in online]),
        "online_free_bytes": mean([_free_bytes(frame["field_bytes"]) for frame in online]),
        "online_seconds": mean([frame.get("total_seconds") for frame in online]),
        "online_cpu_seconds": mean([frame.get("cpu_seconds") for frame in online]),
        "first_cpu_seconds": next((frame.get("cpu_seconds") for frame in frames if frame["index"] == 0), None),
    }


def _free_bytes(fields: Mapping[str, int]) -> int:
    return sum(size for name, size in fields.items() if name.startswith("free"))


def write_result(path: Path, result: Result) -> None:
    """Writes a result whole or not at all.

    Raises:
        StorageError: the file cannot be written.
    """
    content = json.dumps(round_floats(vars(result)), allow_nan=False, separators=(",", ":")) + "\n"
    atomic_write(path, content.encode(), called="The result", new_folder=True)


def round_floats(value: Any) -> Any:
    """Floats rounded to six significant digits, more than measurements have, to keep files small."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {key: round_floats(item) for key, item in value.items()}
    return [round_floats(item) for item in value] if isinstance(value, list | tuple) else value


def read_result(path: Path) -> Result | None:
    """The result in ``path``; None when there is none.

    Raises:
        StorageError: there is something else.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StorageError(f"The result {path} cannot be read ({error.strerror}).") from None
    try:
        return Result(**json.loads(content))
    except (ValueError, TypeError):
        raise StorageError(f"{path} is not a result of an experiment; remove it and run again.") from None


def read_results(folder: Path) -> list[Result]:
    """Every result below ``folder``, by capture, key and seed.

    Raises:
        StorageError: a file cannot be read or is something else.
    """
    found = [result for path in sorted(folder.rglob("*.json")) if (result := read_result(path)) is not None]
    return sorted(found, key=lambda result: (result.capture, result.key, result.seed))
