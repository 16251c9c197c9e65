# SPDX-License-Identifier: Apache-2.0
"""L1 and SSIM with their gradient: this package's C++ against torch and against two public implementations.

All use the 11 x 11 Gaussian window with sigma 1.5, C1 = 0.01^2 and C2 = 0.03^2. This package pads with zeros, as 3D
Gaussian splatting trains; scikit-image and pytorch-msssim take windows inside the picture only. They are therefore
given the picture within five pixels of zeros, of which they make the same numbers: at most 6 % more pixels at 480x360.
"""

import importlib.util
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.benchmark import PICTURES, Benchmark, Growth, Target, Variant
from benchmarks.contest import Contestant, Quantity, Results
from benchmarks.roofline import Work
from structgstream.kernels import cpu_losses, reference_losses

BORDER = 5  # Half a window: what zero padding touches.


def pictures(width: int, height: int) -> tuple[Tensor, Tensor]:
    """A smooth picture with noise ``[H, W, 3]`` and a noisier version of it, float32 in [0, 1]; seeded."""
    g = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(0, 9, height), torch.linspace(0, 12, width), indexing="ij")
    smooth = torch.stack([torch.sin(x + y), torch.cos(2 * x - y), torch.sin(3 * x)], dim=2) * 0.3 + 0.5
    target = (smooth + 0.05 * torch.randn(height, width, 3, generator=g)).clamp(0, 1)
    return (target + 0.05 * torch.randn(height, width, 3, generator=g)).clamp(0, 1).contiguous(), target.contiguous()


def _results(value: Tensor, gradient: Tensor) -> Results:
    """Value, gradient where all windows lie in the picture, and gradient in the border."""
    border = torch.cat([gradient[:BORDER].reshape(-1), gradient[-BORDER:].reshape(-1)])
    return [value.detach(), gradient[2 * BORDER : -2 * BORDER, 2 * BORDER : -2 * BORDER], border]


def _ours(function: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], image: Tensor, target: Tensor) -> Results:
    """SSIM through a back-end's loss; L1 is computed on the way but gets no weight."""
    leaf = image.detach().requires_grad_()
    _, ssim = function(leaf, target)
    (gradient,) = torch.autograd.grad(ssim, leaf)
    return _results(ssim, gradient)


def _bordered(picture: Tensor) -> Tensor:
    return torch.nn.functional.pad(picture, (0, 0, BORDER, BORDER, BORDER, BORDER))


def _msssim(image: Tensor, target: Tensor) -> Results:
    """pytorch-msssim, forward and backward."""
    from pytorch_msssim import ssim  # type: ignore[import-not-found]

    leaf = image.detach().requires_grad_()
    value = ssim(_bordered(leaf).permute(2, 0, 1)[None], _bordered(target).permute(2, 0, 1)[None], data_range=1.0)
    (gradient,) = torch.autograd.grad(value, leaf)
    return _results(value, gradient)


def _skimage(image: Tensor, target: Tensor, *, gradient: bool) -> Results:
    """scikit-image; its gradient is that of the mean over the bordered picture, reflected at the outside.

    So it is scaled to the mean over the picture, and only compared away from the border.
    """
    from skimage.metrics import structural_similarity

    # Its gradient is by the second picture.
    a, b = _bordered(target), _bordered(image)
    found: Any = structural_similarity(
        a.numpy(),
        b.numpy(),
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        gradient=gradient,
    )
    if not gradient:
        return [torch.tensor(float(found)), None, None]
    scale = a.numel() / image.numel() / 3.0  # Its gradient is of each channel's mean, not of their mean.
    scaled = torch.from_numpy(found[1])[BORDER:-BORDER, BORDER:-BORDER] * scale
    return [torch.tensor(float(found[0])), scaled[2 * BORDER : -2 * BORDER, 2 * BORDER : -2 * BORDER], None]


def contestants(*, width: int, height: int) -> list[Contestant]:
    """Torch's grouped convolution first, then the C++, then what is installed of the public ones."""
    image, target = pictures(width, height)
    found = [
        Contestant("torch grouped convolution, 2 threads", partial(_ours, reference_losses.l1_ssim, image, target), 2),
        Contestant("cpu, 1 thread", partial(_ours, cpu_losses.l1_ssim, image, target), 1),
        Contestant("cpu, 2 threads", partial(_ours, cpu_losses.l1_ssim, image, target), 2),
    ]
    if importlib.util.find_spec("pytorch_msssim") is not None:
        found.append(Contestant("pytorch-msssim, 2 threads", partial(_msssim, image, target), 2))
    if importlib.util.find_spec("skimage") is not None:
        found.append(Contestant("scikit-image, value only", partial(_skimage, image, target, gradient=False), 1))
        found.append(Contestant("scikit-image, with gradient", partial(_skimage, image, target, gradient=True), 1))
    return found


def oracle(*, width: int, height: int) -> Results:
    """The torch form in float64."""
    image, target = pictures(width, height)
    return _ours(reference_losses.l1_ssim, image.double(), target.double())


def count(*, width: int, height: int) -> Work:
    """Operations and bytes of value and gradient.

    A pixel and channel forward: three products 3; five blurs, each two passes of 11 multiply-adds, 5 * 44 = 220; the
    formula about 20. Its gradient: the three derivatives about 25, three blurs 132, combining 6. L1 with its gradient:
    4. (The window's symmetry halves the products but leaves as many instructions, a multiply-add being one.)
    Bytes: the picture read by both passes, the target by both, the gradient of SSIM written and read, the result
    written: 7 floats; results of the blurs stay in caches when rows are processed in bands.
    """
    values = 3.0 * width * height
    return Work(values * (3 + 220 + 20 + 25 + 132 + 6 + 4), values * 7 * 4)


BENCHMARK = Benchmark(
    name="ssim",
    work="SSIM of one picture with its gradient",
    contestants=contestants,
    # Against float64: float32 sums round the value, and variances cancel in the gradient (measured: up to 7e-6).
    quantities=[
        Quantity("value", 2e-6, "largest"),
        Quantity("gradient inside", 1e-5),
        Quantity("gradient at the border", 1e-5),
    ],
    variants=[Variant("480x360", {"width": 480, "height": 360}, {"width": 64, "height": 48})],
    growth=[
        Growth(
            "pixels",
            {w * h: {"width": w, "height": h} for w, h in PICTURES},
            {w * h: {"width": w, "height": h} for w, h in ((32, 32), (64, 48))},
            only=("torch grouped convolution, 2 threads", "cpu, 2 threads"),
        )
    ],
    targets=[Target("cpu, 2 threads", at_least_times=8.0)],
    oracle=oracle,
    count=count,
)
