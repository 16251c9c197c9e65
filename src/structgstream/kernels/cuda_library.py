# SPDX-License-Identifier: Apache-2.0
"""The library of this package's CUDA kernels; ``kernels._nvcc`` compiles it."""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels.prototypes import CUDA_PROTOTYPES, declare


@dataclass(frozen=True)
class KernelLibrary:
    """The compiled functions of ``csrc/cuda`` and the device type of their memory.

    Args:
        library: the loaded library.
        device_type: ``cuda``; ``cpu`` for the emulation that tests build.
        stream: gives a device's stream as an integer (0: the default stream).
    """

    library: ctypes.CDLL
    device_type: str
    stream: Callable[[torch.device], int]

    def __post_init__(self) -> None:
        declare(self.library, CUDA_PROTOTYPES)

    def call(self, name: str, *arguments: int | float | None, device: torch.device) -> None:
        """Launch one function.

        Raises:
            BackendError: CUDA reports an error.
        """
        error = getattr(self.library, name)(*arguments, self.stream(device))
        if error:
            said = self.library.sgs_cuda_error(error).decode()
            raise BackendError(f"The CUDA kernels failed ({said}); take the cpu back-end, or report this.")

    def check_devices(self, *tensors: Tensor | None) -> None:
        """Raises unless the kernels can read all of ``tensors``.

        Raises:
            BackendError: one lies elsewhere.
        """
        elsewhere = [t.device for t in tensors if t is not None and t.device.type != self.device_type]
        if elsewhere:
            raise BackendError(
                f"The CUDA kernels read tensors on {self.device_type}, not on {elsewhere[0]}; move the tensors there."
            )


def cuda_stream(device: torch.device) -> int:
    """torch's current stream on ``device``."""
    return torch.cuda.current_stream(device).cuda_stream
