# SPDX-License-Identifier: Apache-2.0
"""What the cuda back-end is made of, on a machine that only says it has a GPU."""

import pytest
import torch

from structgstream.errors import BackendError
from structgstream.kernels import backend, cuda_library, reference_losses, reference_motion, self_check


@pytest.mark.usefixtures("pretended_gpu")
def test_own_operations_are_the_kernels() -> None:
    found, reference, processor = backend.cuda_backend(), backend.reference_backend(), backend.processor_backend()
    assert (found.name, found.device) == ("cuda", torch.device("cuda"))
    assert found.iterations is not None
    own = {name for name, function in found.functions.items() if function is not reference.functions[name]}
    assert own == {
        *("rasterize", "display", "generate_structured", "generate_views", "draw_views", "weigh_views"),
        *("draw_and_weigh_views", "reached_tiles", "l1_ssim", "sweep", "lift", "adam_step"),
        *(name for name in ("confident_flow", "plane_scores") if processor.name == "cpu"),
    }
    assert found.volume is reference_losses.volume
    assert found.changed_pixels is reference_motion.changed_pixels


@pytest.mark.usefixtures("pretended_gpu")
def test_a_gpu_that_draws_otherwise_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_check, "disagreement", lambda rasterize, oracle, device: "the pictures by 0.5")
    with pytest.raises(BackendError, match=r"otherwise than the processor: the pictures by 0\.5\. Use --device cpu"):
        backend.cuda_backend()


def test_without_a_compiler_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda_library, "find_nvcc", lambda environment: None)
    with pytest.raises(BackendError, match="put nvcc on PATH"):
        backend.cuda_backend()
    assert "put nvcc on PATH" in str(backend.backend_reasons()["cuda"])
    assert backend.select_backend("auto").name != "cuda"
