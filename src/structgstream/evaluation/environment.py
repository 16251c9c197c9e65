# SPDX-License-Identifier: Apache-2.0
"""The machine and the versions that a result was obtained with."""

import os
import platform
import shutil
import subprocess
from pathlib import Path
from typing import Any

from structgstream.version import __version__


def environment() -> dict[str, Any]:
    """Python, packages, processor, cores, GPU, and the commit of the sources (None when installed)."""
    import numpy as np
    import torch

    cuda = torch.cuda.is_available()
    return {
        "structgstream": __version__,
        "commit": source_commit(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "platform": platform.platform(),
        "cpu": processor_name(),
        "cores": usable_cores(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if cuda else None,
    }


def usable_cores() -> int:
    """Number of cores that this process may use, which a container may limit."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor_name() -> str:
    """The processor's model name, if the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def source_commit() -> str | None:
    """The commit of the working copy that this package runs from; ``-dirty`` when it has changes."""
    folder = Path(__file__).parents[1]
    git = shutil.which("git")
    # Check that the sources are tracked: an environment may lie inside another repository.
    if git is None or _output(git, "ls-files", "--error-unmatch", "__init__.py", folder=folder) is None:
        return None
    return _output(git, "describe", "--always", "--dirty", "--exclude=*", folder=folder)


def _output(*command: str, folder: Path) -> str | None:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
