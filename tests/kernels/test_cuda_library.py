# SPDX-License-Identifier: Apache-2.0
"""The CUDA sources compile where NVIDIA's compiler is, and without it everything says why."""

import ctypes
import os
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from structgstream.errors import BackendError
from structgstream.kernels import cuda, cuda_library
from structgstream.kernels.cuda_library import CUDA_PROTOTYPES

SOURCES = Path(__file__).parents[2] / "csrc" / "cuda"
NVCC = cuda_library.find_nvcc(os.environ)
needs_nvcc = pytest.mark.skipif(NVCC is None, reason="nvcc, NVIDIA's compiler, was not found")


def pretended(folder: Path, script: str) -> Path:
    """A compiler that logs its calls and does what ``script`` says; ``$out`` is the file it is asked for."""
    folder.mkdir(parents=True, exist_ok=True)
    program = folder / "nvcc"
    program.write_text(
        '#!/bin/sh\nif [ "$1" = --version ]; then echo "release 1.0"; exit; fi\n'
        f'echo call >>"{folder}/calls"\n'
        'while [ $# -gt 0 ]; do if [ "$1" = -o ]; then out=$2; fi; shift; done\n' + script
    )
    program.chmod(0o755)
    return program


@needs_nvcc
def test_the_sources_compile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert NVCC is not None
    monkeypatch.setenv("NVCC_APPEND_FLAGS", "-Xcicc -O0 -Xptxas -O0")  # What is compiled is tested, not how fast it is.
    path = cuda_library.compiled("sm_80", nvcc=NVCC, sources=SOURCES, cache=tmp_path)
    library = ctypes.CDLL(str(path))  # CUDA's runtime is linked in, so it loads without a GPU.
    for name in CUDA_PROTOTYPES:
        assert hasattr(library, name)
    assert library.sgs_cuda_driver_fits() in (0, 1)
    library.sgs_cuda_error.restype = ctypes.c_char_p
    assert library.sgs_cuda_error(ctypes.c_int(1)) == b"invalid argument"


def test_the_sources_are_installed() -> None:
    installed = cuda_library.source_folder()
    if installed == SOURCES:
        pytest.skip("structgstream was not installed from its wheel or by cmake --install")
    assert {path.name for path in SOURCES.iterdir() if not path.name.startswith("emulate")} == {
        path.name for path in installed.iterdir()
    }


def test_a_library_is_compiled_once_until_something_changes(tmp_path: Path) -> None:
    nvcc = pretended(tmp_path / "bin", 'echo library >"$out"')
    sources, cache = tmp_path / "sources", tmp_path / "cache"
    sources.mkdir()
    (sources / "a.cu").write_text("one")
    (sources / "a.h").write_text("one")

    def path() -> Path:
        return cuda_library.compiled("sm_90", nvcc=nvcc, sources=sources, cache=cache)

    first = path()
    assert first.read_text() == "library\n"
    assert path() == first
    (sources / "a.h").write_text("two")
    assert path() != first
    assert cuda_library.compiled("sm_80", nvcc=nvcc, sources=sources, cache=cache) not in (first, path())
    assert (tmp_path / "bin" / "calls").read_text().split() == ["call"] * 3
    assert len(list(cache.iterdir())) == 3


def test_a_failing_compiler_is_quoted_and_leaves_nothing(tmp_path: Path) -> None:
    nvcc = pretended(tmp_path / "bin", 'echo half >"$out"; echo "unsupported GNU version" >&2; exit 2')
    with pytest.raises(BackendError, match="unsupported GNU version"):
        cuda_library.compiled("sm_90", nvcc=nvcc, sources=SOURCES, cache=tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    nvcc = pretended(tmp_path / "bin", "")
    with pytest.raises(BackendError, match="There are no CUDA sources"):
        cuda_library.compiled("sm_90", nvcc=nvcc, sources=tmp_path, cache=tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(BackendError, match="set XDG_CACHE_HOME"):
        cuda_library.compiled("sm_90", nvcc=nvcc, sources=SOURCES, cache=tmp_path / "file" / "cache")


def test_where_the_compiler_is_looked_for(tmp_path: Path) -> None:
    home, path = (pretended(tmp_path / name / "bin", "") for name in ("home", "path"))
    assert cuda_library.find_nvcc({"CUDA_HOME": str(tmp_path / "home"), "PATH": str(path.parent)}) == home
    assert cuda_library.find_nvcc({"CUDA_HOME": str(tmp_path / "nowhere"), "PATH": str(path.parent)}) == path


def test_where_libraries_are_kept(tmp_path: Path) -> None:
    assert cuda_library.cache_folder({"XDG_CACHE_HOME": str(tmp_path)}) == tmp_path / "structgstream" / "cuda"
    assert cuda_library.cache_folder({}) == Path.home() / ".cache" / "structgstream" / "cuda"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """A machine that says it has a GPU; returns the path of the kernels that its package carries."""

    def pretend(*, nvcc: Path | None, capability: tuple[int, int] = (9, 0)) -> Path:
        packaged = tmp_path / "libstructgstream_cuda.so"
        monkeypatch.setattr(cuda_library, "find_nvcc", lambda environment: nvcc)
        monkeypatch.setattr(cuda_library, "source_folder", lambda: SOURCES)
        monkeypatch.setattr(cuda_library, "cache_folder", lambda environment: tmp_path / "cache")
        monkeypatch.setattr(cuda_library, "packaged_path", lambda: packaged)
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: capability)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        cuda_library.kernel_library.cache_clear()
        return packaged

    return pretend


@pytest.mark.parametrize("found", [False, True])
def test_without_kernels_it_says_why(found: bool, tmp_path: Path, machine: Callable[..., Path]) -> None:
    broken = pretended(tmp_path / "bin", 'echo "no host compiler" >&2; exit 1')
    machine(nvcc=broken if found else None)
    with pytest.raises(BackendError, match="no host compiler" if found else "put nvcc on PATH"):
        cuda_library.kernel_library()
    reason = cuda.cuda_reason()
    assert reason is None if found else "put nvcc on PATH" in str(reason)


def test_a_wheel_with_kernels_needs_no_compiler(machine: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    packaged = machine(nvcc=None)
    packaged.write_bytes(b"")
    functions: Any = SimpleNamespace(**{name: lambda: 1 for name in CUDA_PROTOTYPES})
    monkeypatch.setattr(ctypes, "CDLL", lambda path: functions)
    assert cuda.cuda_reason() is None
    assert cuda_library.kernel_library().library is functions


@pytest.mark.parametrize(
    ("capability", "driver_fits", "reason"),
    [
        ((7, 5), True, r"need a GPU of compute capability 8\.0, and this one has 7\.5\. To compile them, install"),
        ((9, 0), False, r"driver of the GPU is older than the compiled CUDA kernels need; update it\. To compile"),
        ((9, 0), None, r"compiled CUDA kernels do not load \(.*file too short\)\. To compile"),
    ],
)
def test_kernels_of_a_wheel_that_do_not_fit(
    capability: tuple[int, int],
    driver_fits: bool | None,
    reason: str,
    machine: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine(nvcc=None, capability=capability).write_bytes(b"")
    if driver_fits is not None:
        functions = SimpleNamespace(**{name: lambda: int(driver_fits) for name in CUDA_PROTOTYPES})
        monkeypatch.setattr(ctypes, "CDLL", lambda path: functions)
    assert re.search(reason, str(cuda.cuda_reason()))
    with pytest.raises(BackendError, match=reason):
        cuda_library.kernel_library()
