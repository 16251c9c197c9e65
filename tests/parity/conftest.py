# SPDX-License-Identifier: Apache-2.0
"""The instruction sets that this machine can run the kernels on, and the CUDA kernels run on a processor."""

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from torch import Tensor

from structgstream.kernels.cuda_library import KernelLibrary, kernel_library
from structgstream.kernels.native import ISA_NAMES, native_library, native_reason
from tests.support.shared_folder import made_once

SOURCES = Path(__file__).parents[2] / "csrc" / "cuda"


@pytest.fixture(params=range(len(ISA_NAMES)), ids=ISA_NAMES)
def isa(request: pytest.FixtureRequest) -> Iterator[int]:
    """One run of the test for each instruction set."""
    with using_isa(request.param):
        yield request.param


@contextmanager
def using_isa(isa: int) -> Iterator[None]:
    """The kernels for an instruction set within; the test is skipped where it is missing."""
    if native_reason() is not None:
        pytest.skip(str(native_reason()))
    library = native_library()
    if isa > library.sgs_best_isa():
        pytest.skip(f"this processor or build has no {ISA_NAMES[isa]}")
    library.sgs_use_isa(isa)
    try:
        yield
    finally:
        library.sgs_use_isa(len(ISA_NAMES))


def check_any_threads(run: Callable[[], Iterable[Tensor]], counts: Sequence[int] = (1, 2, 3)) -> None:
    """``run`` finds the same bits with any number of threads; tests/conftest.py restores that."""
    found = []
    for count in counts:
        torch.set_num_threads(count)
        found.append([*run()])
    assert all(torch.equal(one, other) for again in found[1:] for one, other in zip(found[0], again, strict=True))


def in_both_orders(
    emulation: Callable[[int], KernelLibrary], run: Callable[[KernelLibrary], Iterable[Tensor]]
) -> list[Tensor]:
    """What ``run`` finds, after a check that the order of threads and blocks does not matter."""
    found, again = ([*run(emulation(order))] for order in (0, 1))
    assert all(torch.equal(one, other) for one, other in zip(found, again, strict=True))
    return found


@pytest.fixture(scope="session")
def emulation() -> Callable[[int], KernelLibrary]:
    """The interface of the CUDA kernels on the processor; the argument says in which order threads run (0 or 1)."""
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler to build the emulation with")
    flags = ["-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", "-Wno-psabi", "-shared", "-fPIC"]
    command = [compiler, *flags, *sorted(SOURCES.glob("emulate_*.cpp")), "-o"]
    folder = made_once("emulation", lambda folder: subprocess.run([*command, folder / "built.so"], check=True))
    library = ctypes.CDLL(str(folder / "built.so"))
    return lambda order: KernelLibrary(library, "cpu", lambda device: order)


@pytest.fixture
def kernels_on(request: pytest.FixtureRequest) -> Callable[[str], KernelLibrary]:
    """The CUDA kernels of a device type: their emulation for ``cpu``."""

    def kernels(device_type: str) -> KernelLibrary:
        return request.getfixturevalue("emulation")(0) if device_type == "cpu" else kernel_library()

    return kernels
