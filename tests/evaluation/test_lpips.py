# SPDX-License-Identifier: Apache-2.0
"""LPIPS with seeded weights against a second implementation, and what is said about files of weights.

Seeded weights show that the arithmetic is right; they are no LPIPS.
"""

import hashlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from structgstream.errors import ConfigError
from structgstream.evaluation.lpips import (
    ALEX,
    ENVIRONMENT,
    TRUNKS,
    VGG,
    Lpips,
    Trunk,
    load_lpips,
    published_heads,
    weights_file,
)

CPU = torch.device("cpu")


def network(trunk: Trunk) -> tuple[nn.Sequential, list[int]]:
    """The published architecture as torchvision numbers it, and the numbers of the rectifiers that are tapped."""
    if trunk is ALEX:
        modules = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)]
        modules += [nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)]
        for inner, outer in pairwise((192, 384, 256, 256)):
            modules += [nn.Conv2d(inner, outer, 3, padding=1), nn.ReLU()]
        return nn.Sequential(*modules), [1, 4, 7, 9, 11]
    modules, inner, taps = [], 3, []
    for entry in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0):
        if not entry:
            taps.append(len(modules) - 1)
            modules.append(nn.MaxPool2d(2, 2))
        else:
            modules += [nn.Conv2d(inner, entry, 3, padding=1), nn.ReLU()]
            inner = entry
    return nn.Sequential(*modules), taps


def seeded(trunk: Trunk) -> nn.Sequential:
    torch.manual_seed(5)
    net, _ = network(trunk)
    for module in net:
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            nn.init.normal_(module.bias, std=0.1)
    return net


def written(trunk: Trunk, folder: Path, name: str) -> Path:
    """A state dict of a whole network's shape, as torchvision's files are."""
    state = {f"features.{key}": value for key, value in seeded(trunk).state_dict().items()}
    torch.save(state | {"classifier.6.weight": torch.zeros(2, 2)}, folder / name)
    return folder / name


def reference(trunk: Trunk, a: np.ndarray, b: np.ndarray) -> float:
    """LPIPS as its paper and its version 0.1 say, in float64 with torch's modules."""
    net, taps = seeded(trunk).double(), network(trunk)[1]
    xs = []
    for picture in (a, b):
        x = torch.from_numpy(picture / 255.0).permute(2, 0, 1)[None] * 2 - 1
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        xs.append((x - shift.double().view(1, 3, 1, 1)) / scale.double().view(1, 3, 1, 1))
    total = 0.0
    for tap, head in zip(taps, published_heads(trunk)):
        fs = [net[: tap + 1](x) for x in xs]
        fs = [f / (f.norm(dim=1, keepdim=True) + 1e-10) for f in fs]
        weighted = nn.functional.conv2d((fs[0] - fs[1]) ** 2, head.double().view(1, -1, 1, 1))
        total += float(weighted.mean())
    return total


def pictures(height: int = 70, width: int = 83) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    a = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    return a, np.clip(a + rng.normal(0, 40, a.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    written(ALEX, folder, "alexnet.pth")
    written(VGG, folder, "vgg16-seeded.pth")
    return folder


def loaded(trunk: Trunk, folder: Path) -> Lpips:
    return load_lpips(trunk, weights_file(trunk, folder), CPU)


@pytest.mark.parametrize("trunk", TRUNKS, ids=["alex", "vgg"])
def test_the_arithmetic_is_that_of_a_second_implementation(trunk: Trunk, folder: Path) -> None:
    lpips = loaded(trunk, folder)
    a, b = pictures()
    fa, fb = lpips.features(a), lpips.features(b)
    with torch.no_grad():
        expected = reference(trunk, a, b)
    assert expected > 0.01
    assert lpips.distance(fa, fb) == pytest.approx(expected, rel=1e-4)
    assert lpips.distance(fb, fa) == pytest.approx(lpips.distance(fa, fb), rel=1e-6)
    assert lpips.distance(fa, lpips.features(a.copy())) == 0.0
    assert [len(feature) for feature in fa] == [len(head) for head in lpips.heads]


@pytest.mark.parametrize("trunk", TRUNKS, ids=["alex", "vgg"])
def test_the_smallest_picture_is_the_smallest(trunk: Trunk, folder: Path) -> None:
    lpips = loaded(trunk, folder)
    small, _ = pictures(trunk.smallest, trunk.smallest)
    assert lpips.features(small)[-1].shape[1:] == (1, 1)
    with pytest.raises(RuntimeError):
        lpips.features(pictures(trunk.smallest - 1, 64)[0])


def test_the_published_heads_weigh_and_never_reward() -> None:
    for trunk in TRUNKS:
        taps = [layer.shape[0] for layer in trunk.layers if layer.tap]
        heads = published_heads(trunk)
        assert [len(head) for head in heads] == taps
        assert all(float(head.min()) >= 0.0 for head in heads)
    digest = hashlib.sha256(b"".join(h.numpy().tobytes() for trunk in TRUNKS for h in published_heads(trunk)))
    assert digest.hexdigest() == "4d2f82151894aec30dadde0050597d43933fad2081591795703153fb1a8e31b5"


def test_places_are_searched_in_order(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert weights_file(ALEX) is None
    cache = tmp_path / "hub" / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    (cache / ALEX.file).write_bytes(b"x")
    assert weights_file(ALEX) == cache / ALEX.file
    monkeypatch.setenv(ENVIRONMENT, str(folder))
    assert weights_file(ALEX) == folder / "alexnet.pth"
    given = tmp_path / "alexnet-mine.pth"
    given.write_bytes(b"x")
    assert weights_file(ALEX, given) == given
    assert weights_file(VGG, given) == folder / "vgg16-seeded.pth"
    with pytest.raises(ConfigError, match="no .*nowhere, where the path given"):
        weights_file(ALEX, tmp_path / "nowhere")
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path / "gone"))
    with pytest.raises(ConfigError, match=f"gone, where {ENVIRONMENT}"):
        weights_file(ALEX)


def test_wrong_files_are_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "text.pth").write_text("not a file of torch's")
    with pytest.raises(ConfigError, match=r"text\.pth cannot be read as weights of AlexNet"):
        load_lpips(ALEX, tmp_path / "text.pth", CPU)
    with pytest.raises(ConfigError, match=r"features\.0\.weight .* \(64, 3, 11, 11\).*\(64, 3, 3, 3\)"):
        load_lpips(ALEX, folder / "vgg16-seeded.pth", CPU)
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(ConfigError, match="got nothing"):
        load_lpips(VGG, tmp_path / "list.pth", CPU)
    renamed = tmp_path / "alexnet-owt-7be5be79.pth"
    renamed.write_bytes((folder / "alexnet.pth").read_bytes())
    with pytest.raises(ConfigError, match="SHA-256 .* download it again"):
        load_lpips(ALEX, renamed, CPU)
    digest = hashlib.sha256(renamed.read_bytes()).hexdigest()[:8]
    honest = renamed.rename(tmp_path / f"alexnet-{digest}.pth")
    assert load_lpips(ALEX, honest, CPU).trunk is ALEX
