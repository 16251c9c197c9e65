# SPDX-License-Identifier: Apache-2.0
"""This package's CUDA kernels: carried by the wheel, or compiled once per GPU architecture; calls to them.

A wheel that was built where nvcc is carries compiled kernels (``STRUCTGSTREAM_CUDA`` in CMakeLists.txt). The sources
are in every package, for GPUs and drivers that these do not fit.
"""

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor

from structgstream.atomic_files import give_name
from structgstream.errors import BackendError, OutOfMemoryError
from structgstream.kernels.native import addresses, declare

CUDA_PROTOTYPES: Mapping[str, tuple[str, str]] = {
    "sgs_cuda_l1_ssim": ("i", "pppiippppppp"),
    "sgs_cuda_l1_ssim_backward": ("i", "pppiipppppppp"),
    "sgs_cuda_error": ("s", "i"),
    "sgs_cuda_driver_fits": ("i", ""),
    "sgs_cuda_lift": ("i", "pp"),
    "sgs_cuda_views": ("i", "pip"),
    "sgs_cuda_reached_tiles": ("i", "pip"),
    "sgs_cuda_display": ("i", "pp"),
    "sgs_cuda_raster_new": ("i", "ppp"),
    "sgs_cuda_raster_backward": ("i", "ppppp"),
    "sgs_cuda_raster_free": ("v", "p"),
    "sgs_cuda_fit_new": ("i", "plpp"),
    "sgs_cuda_fit_run": ("i", "pii"),
    "sgs_cuda_fit_free": ("v", "p"),
    "sgs_cuda_anchor_inputs": ("i", "ppppppiiiiipppiifpppp"),
    "sgs_cuda_anchor_inputs_backward": ("i", "piiipppp"),
    "sgs_cuda_anchor_outputs": ("i", "ppppiiipppppppppppp"),
    "sgs_cuda_anchor_outputs_backward": ("i", "pppiipppppppppppppppp"),
    "sgs_cuda_sweep": ("i", "piippiiifpppp"),
}
"""For each function of csrc/cuda: result type, argument types in order (``native.TYPES``)."""
FLAGS = ("-O3", "-std=c++17", "-shared", "-Xcompiler", "-fPIC", "--threads", "0")
SHARED_HEADERS = ("include", "cpu")
"""Folders next to that of the sources, with the headers of the C interface of the CPU kernels."""
MIN_CAPABILITY = (8, 0)
"""Compute capability that a wheel's kernels need: the oldest of ``SGS_CUDA_ARCHITECTURES`` in CMakeLists.txt."""
_NO_MEMORY = 2  # cudaErrorMemoryAllocation
_LAST_LINES = 5  # of a failing compiler's output that an error quotes


@dataclass(frozen=True)
class KernelLibrary:
    """The compiled functions of ``csrc/cuda`` and the device type of their memory.

    Args:
        library: the loaded library.
        device_type: ``cuda``; ``cpu`` for the emulation that tests build.
        stream: returns a device's CUDA stream as an integer (0: the default stream).
    """

    library: ctypes.CDLL
    device_type: str
    stream: Callable[[torch.device], int]

    def __post_init__(self) -> None:
        declare(self.library, CUDA_PROTOTYPES)

    def call(self, name: str, *arguments: Tensor | int | float | None, device: torch.device) -> None:
        """Launch one function; errors are those of :meth:`check`."""
        self.check(getattr(self.library, name)(*arguments, self.stream(device)))

    def addresses(self, *tensors: Tensor | None) -> list[int | None]:
        """Address of each tensor's data on the device; None (null) for None."""
        return addresses(*tensors)

    def check(self, error: int) -> None:
        """Check the number that a function returned.

        Raises:
            OutOfMemoryError: the GPU has no memory for what the function needs.
            BackendError: CUDA reports another error.
        """
        if error == _NO_MEMORY:
            raise OutOfMemoryError("on the GPU", on_gpu=True)
        if error:
            message = self.library.sgs_cuda_error(error).decode()
            raise BackendError(f"The CUDA kernels failed ({message}); take the cpu back-end, or report this.")

    def check_devices(self, *tensors: Tensor | None) -> None:
        """Check that the kernels can read all of ``tensors``.

        Raises:
            BackendError: a tensor is on another device.
        """
        elsewhere = [t.device for t in tensors if t is not None and t.device.type != self.device_type]
        if elsewhere:
            raise BackendError(
                f"The CUDA kernels read tensors on {self.device_type}, not on {elsewhere[0]}; move the tensors there."
            )


def cuda_stream(device: torch.device) -> int:
    """torch's current stream on ``device``."""
    return torch.cuda.current_stream(device).cuda_stream


def source_folder() -> Path:
    """The folder of the installed sources; that of the clone for a package that runs from one."""
    installed = Path(str(files("structgstream") / "_native" / "cuda"))
    clone = Path(__file__).parents[3] / "csrc" / "cuda"
    return clone if clone.is_dir() and not installed.is_dir() else installed


def find_nvcc(environment: Mapping[str, str]) -> Path | None:
    """NVIDIA's compiler: from ``CUDA_HOME`` or ``CUDA_PATH``, ``PATH``, or its default folder; None if not found."""
    folders = [Path(environment[name]) / "bin" for name in ("CUDA_HOME", "CUDA_PATH") if environment.get(name)]
    on_path = shutil.which("nvcc", path=environment.get("PATH", ""))
    candidates = [folder / "nvcc" for folder in folders]
    candidates += [Path(on_path)] if on_path else []
    candidates.append(Path("/usr/local/cuda/bin/nvcc"))
    return next((path for path in candidates if os.access(path, os.X_OK) and path.is_file()), None)


def cache_folder(environment: Mapping[str, str]) -> Path:
    """The folder of compiled libraries, in the user's cache."""
    root = environment.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "structgstream" / "cuda"


def compiled(architecture: str, *, nvcc: Path, sources: Path, cache: Path) -> Path:
    """Path of the library for ``architecture`` (``sm_90``), compiled unless ``cache`` has it.

    Its file name is a hash of the sources, the compiler's version, the flags and the architecture. It is renamed into
    place, so processes that compile at the same time do not see a partial file.

    Raises:
        BackendError: the sources are missing, the compiler fails, or the cache cannot be written.
    """
    units = sorted(sources.glob("*.cu"))
    if not units:
        raise BackendError(f"There are no CUDA sources in {sources}; install structgstream again.")
    virtual = architecture.replace("sm_", "compute_")
    flags = [*FLAGS, "-gencode", f"arch={virtual},code={architecture}"]
    state = hashlib.sha256("\n".join([_output([str(nvcc), "--version"]), *flags]).encode())
    shared = [path for folder in SHARED_HEADERS for path in sources.parent.joinpath(folder).glob("*.h")]
    for path in sorted([*units, *sources.glob("*.h"), *shared]):
        state.update(path.name.encode() + b"\0" + path.read_bytes())
    library = cache / f"{architecture}-{state.hexdigest()[:32]}.so"
    if library.is_file():
        return library
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as scratch:
            built = Path(scratch) / library.name
            _output([str(nvcc), *flags, "-o", str(built), *map(str, units)])
            give_name(built, library)
    except OSError as error:
        raise BackendError(f"CUDA kernels cannot be written to {cache} ({error}); set XDG_CACHE_HOME.") from error
    return library


def _output(command: list[str]) -> str:
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        message = "\n".join((result.stderr or result.stdout).strip().splitlines()[-_LAST_LINES:])
        raise BackendError(f"{command[0]} failed with status {result.returncode}: {message}")
    return result.stdout


def packaged_path() -> Path:
    """Where a wheel that was built with nvcc has the compiled kernels."""
    return Path(str(files("structgstream") / "_native" / "libstructgstream_cuda.so"))


def packaged_reason() -> str | None:
    """Why the kernels that the package carries do not run on this machine's GPU; None if they do."""
    path = packaged_path()
    if not path.is_file():
        return "This installation of structgstream carries no compiled CUDA kernels"
    if (capability := torch.cuda.get_device_capability()) < MIN_CAPABILITY:
        needed, found = (".".join(map(str, version)) for version in (MIN_CAPABILITY, capability))
        return f"The compiled CUDA kernels need a GPU of compute capability {needed}, and this one has {found}"
    try:
        fits = _load(path).library.sgs_cuda_driver_fits()
    except OSError as error:
        return f"The compiled CUDA kernels do not load ({error})"
    return None if fits else "The driver of the GPU is older than the compiled CUDA kernels need; update it"


def library_reason() -> str | None:
    """Why there are no kernels for this machine's GPU and how to change that; None if there are or can be compiled."""
    reason = packaged_reason()
    if reason is None or find_nvcc(os.environ) is not None:
        return None
    return f"{reason}. To compile them, install NVIDIA's CUDA toolkit and put nvcc on PATH or set CUDA_HOME."


@cache
def kernel_library() -> KernelLibrary:
    """The kernels for this machine's GPU. The first call compiles them, where the package's own do not fit.

    Raises:
        BackendError: there are no kernels and no compiler, it fails, or the library does not load.
    """
    if packaged_reason() is None:
        return _load(packaged_path())
    nvcc = find_nvcc(os.environ)
    if nvcc is None:
        raise BackendError(str(library_reason()))
    major, minor = torch.cuda.get_device_capability()
    path = compiled(f"sm_{major}{minor}", nvcc=nvcc, sources=source_folder(), cache=cache_folder(os.environ))
    try:
        return _load(path)
    except OSError as error:
        raise BackendError(f"The CUDA kernels do not load ({error}); take the cpu back-end, or report this.") from error


def _load(path: Path) -> KernelLibrary:
    return KernelLibrary(ctypes.CDLL(str(path)), "cuda", cuda_stream)
