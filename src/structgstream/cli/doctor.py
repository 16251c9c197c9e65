# SPDX-License-Identifier: Apache-2.0
"""``structgstream doctor``."""

import importlib.metadata
import importlib.util
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from structgstream.cli.options import JsonPath, check_ending, parse_options, write_json_output
from structgstream.cli.progress import compact_table, literal_cells, name_value_table

# Import name, distribution, extra, what it is for.
OPTIONAL = (
    ("av", "av", "capture", "read and write video"),
    ("cv2", "opencv-python-headless", "capture", "read pictures, initial points"),
    ("PIL", "pillow", "capture", "read pictures, export to .sog"),
    ("scipy", "scipy", "capture", "initial points"),
    ("yaml", "pyyaml", "capture", "read calibrations of Kalibr"),
    ("pycolmap", "pycolmap", "sfm", "command prepare"),
    ("matplotlib", "matplotlib", "report", "plots, contact sheets"),
    ("starlette", "starlette", "serve", "commands play and serve"),
    ("uvicorn", "uvicorn", "serve", "commands play and serve"),
    ("prometheus_client", "prometheus-client", "serve", "command serve"),
    ("pxr", "usd-core", "export", "export to .usd"),
    ("fourdgs", "fourdgs", "export", "export to .4dgs"),
    ("s3fs", "s3fs", "cloud", "publish segments to S3"),
    ("ray", "ray", "cluster", "parallel runs on several machines"),
    ("anywidget", "anywidget", "notebook", "player in notebooks"),
)


@dataclass(frozen=True)
class Doctor:
    """Shows the back-ends and optional packages of this machine, and how to install missing ones.

    Example: structgstream doctor
    """

    json: JsonPath = None
    """Write the result to this file; - is standard output."""


def main(arguments: list[str]) -> None:
    """Examines the machine and prints the result."""
    options = parse_options(Doctor, "doctor", arguments=arguments)
    check_ending(options.json, ".json", command="doctor", option="--json")
    found = diagnose()
    console = write_json_output(options.json, found)
    machine = name_value_table()
    for name, value in found["environment"].items():
        machine.add_row(*literal_cells(name, "-" if value is None else str(value)))
    console.print(machine)
    console.print()
    console.print(_table(("back-end", "state", ""), [(e["name"], e["state"], e["advice"]) for e in found["backends"]]))
    console.print()
    rows = [(e["name"], e["version"] or "missing", f"{e['purpose']}{e['advice']}") for e in found["packages"]]
    console.print(_table(("package", "version", ""), rows))


def diagnose() -> dict[str, Any]:
    """Machine, back-ends and optional packages as plain values: ``environment``, ``backends``, ``packages``."""
    from structgstream.evaluation.environment import environment
    from structgstream.kernels.backend import backend_reasons

    reasons = backend_reasons()
    chosen = next(name for name, reason in reasons.items() if reason is None)
    backends = [
        {
            "name": name,
            "available": reason is None,
            "state": "missing" if reason else "chosen by --device auto" if name == chosen else "available",
            "advice": reason or "",
        }
        for name, reason in reasons.items()
    ]
    packages = []
    for module, distribution, extra, purpose in OPTIONAL:
        version = _version(module, distribution)
        advice = "" if version else f"; get it with: pip install 'structgstream[{extra}]'"
        packages.append({"name": module, "version": version, "extra": extra, "purpose": purpose, "advice": advice})
    return {"environment": environment(), "backends": backends, "packages": packages}


def _version(module: str, distribution: str) -> str | None:
    """The version of a module; None if it is not there."""
    if importlib.util.find_spec(module) is None:
        return None
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:  # Copied, not installed.
        return "without a version"


def _table(names: tuple[str, ...], rows: list[tuple[str, ...]]) -> Table:
    table = compact_table(*names, left=names)
    for row in rows:
        table.add_row(*literal_cells(*row))
    return table
