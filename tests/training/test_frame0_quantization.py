# SPDX-License-Identifier: Apache-2.0
"""Frame 0 as quantization indices."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from structgstream.cameras import CameraRig
from structgstream.scene.appearance import with_appearance
from structgstream.scene.render import render
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, scene_of, state_of
from structgstream.training.frame0.quantization import (
    COARSEST,
    FINEST,
    SENSITIVITY_FIELDS,
    Sensitivity,
    _quantize_rows,
    estimate_sensitivity,
    quantize_first_frame,
    whiten_features,
)
from structgstream.training.parameters import RoundingConfig
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig, random_scene
from tests.support.varied import varied

BACKEND = quickest_backend()
RIG = arc_rig(7, width=40, height=32)
VOXEL = 0.02
STEPS = {"anchor_positions": 0.003, "offset_scales": 0.02}


@cache
def before() -> tuple[Scene, Sensitivity]:
    scene = random_scene(40, seed=3)
    return scene, estimate_sensitivity(scene, RIG, backend=BACKEND, seed=0)


@cache
def after() -> tuple[Scene, Sensitivity]:
    return whiten_features(*before())


def pictures(scene: Scene, rig: CameraRig = RIG) -> torch.Tensor:
    return torch.stack([render(scene, rig[name], BACKEND).image for name in rig.training])


def noise_levels(scene: Scene) -> float:
    return 255.0 * float((pictures(scene) - pictures(before()[0])).square().mean().sqrt())


def test_what_numbers_are_worth_is_what_errors_of_them_do() -> None:
    """A small error of all numbers of a field adds the noise that was foretold, to within chance."""
    scene, sensitivity = before()
    g, state = torch.Generator().manual_seed(1), state_of(scene)
    exact = pictures(scene)
    sizes: dict[FieldName, float] = {"anchor_offsets": 3e-3, "anchor_features": 1e-2, "base_scales": 1e-2}
    for name, size in sizes.items():
        error = size * torch.randn(state[name].shape, generator=g)
        wrong: dict[FieldName, torch.Tensor] = {**state, name: state[name] + error}
        found = float((pictures(scene_of(wrong, distance_input=True)) - exact).square().mean())
        foretold = size**2 * float(sensitivity.fields[name].sum())
        assert 0.5 < found / foretold < 2.0, name


def test_what_no_camera_draws_is_not_used() -> None:
    scene, sensitivity = before()
    used = torch.zeros_like(sensitivity.used)
    for name in RIG.training:
        structured = scene.structured(RIG[name], BACKEND).gaussians
        used.view(-1)[structured.ids] = True
    assert torch.equal(sensitivity.used, used)
    assert 0 < int(sensitivity.used.sum()) < sensitivity.used.numel()
    assert not sensitivity.fields["anchor_offsets"][~sensitivity.used].any()


def test_another_gauge_draws_the_same() -> None:
    scene, _ = before()
    other, _ = after()
    assert float((pictures(other) - pictures(scene)).abs().max()) < 1e-4
    assert not other.anchors.log_offset_scales.any()
    assert not torch.allclose(other.anchors.features, scene.anchors.features, atol=0.1)


def test_directions_of_features_are_independent_and_worth_the_same() -> None:
    scene, _ = after()
    features = scene.anchors.features.double()
    covariance = torch.cov(features.T)
    variances = covariance.diagonal()
    assert (variances.diff() <= 1e-6 * variances[0]).all(), "the most varied first"
    assert float((covariance - variances.diag()).abs().max()) < 1e-4 * float(variances[0])
    assert float(features.mean(0).abs().max()) < 1e-5
    products = estimate_sensitivity(scene, RIG, backend=BACKEND, seed=0).features
    strong = products.diagonal() > 0.5 * products.diagonal().max()
    assert strong.sum() > len(products) // 2
    inner = products[strong][:, strong]
    assert float((inner / inner.diagonal().mean() - torch.eye(len(inner))).abs().max()) < 0.05


def test_the_worth_of_another_gauge_is_that_of_the_numbers_there() -> None:
    """Of features the sum over an anchor is reported, of all other fields every number."""
    scene, reported = after()
    found = estimate_sensitivity(scene, RIG, backend=BACKEND, seed=0)
    assert torch.equal(found.used, reported.used)
    one, other = found.fields, reported.fields
    for name in ("anchor_offsets", "base_scales"):
        torch.testing.assert_close(one[name], other[name], rtol=2e-2, atol=1e-4 * float(one[name].max()))
    torch.testing.assert_close(one["anchor_features"].sum(), other["anchor_features"].sum(), rtol=2e-2, atol=0)


def quantized(levels: float, *, quality: float = 0.0) -> tuple[Scene, dict[FieldName, float]]:
    config = varied(RoundingConfig(quality=quality), FIRST_NOISE_LEVELS=levels)
    scene, sensitivity = after()
    return quantize_first_frame(with_appearance(scene, 2), sensitivity, config=config, voxel_size=VOXEL, steps=STEPS)


@pytest.mark.parametrize("levels", [0.3, 1.0, 3.0])
def test_the_noise_is_about_what_was_asked_for(levels: float) -> None:
    scene, _ = quantized(levels)
    found = noise_levels(scene)
    assert 0.3 * levels < found < 3.0 * levels


def test_rows_that_pictures_depend_on_more_are_finer() -> None:
    """A row whose noise costs sixteen times as much has a quarter of the step."""
    sensitivities = torch.ones(40, 3)
    sensitivities[::2] = 16.0
    values = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    step, rounded = _quantize_rows(values, sensitivities, 0.01, counted=None)
    errors = (rounded - values).abs()
    assert errors[::2].max() * 3 < errors[1::2].max()
    assert step * 2.0 ** (COARSEST - FINEST) >= 2 * errors.max()


def test_everything_that_is_coded_is_a_whole_number_of_steps() -> None:
    scene, steps = quantized(0.5)
    state = state_of(scene)
    assert steps.keys() == state.keys() - {"free", "free_births", "camera_color"}
    for name, step in steps.items():
        bins = state[name].double() / step
        assert float((bins - bins.round()).abs().max()) < 1e-3, name
        assert float(torch.tensor(step, dtype=torch.float32)) == step
    rows = (state["anchor_features"].double() / steps["anchor_features"]).round().long()
    powers = 2 ** torch.arange(COARSEST - FINEST + 1)
    coarse = [(rows % power == 0).all(1).float().mean() for power in powers]
    assert coarse[0] == 1.0
    assert 0.05 < coarse[1] < 1.0, "rows differ in what they are worth"


def test_what_is_not_used_is_zero() -> None:
    scene, _ = quantized(0.5)
    used = before()[1].used
    assert not scene.anchors.offsets[~used].any()
    assert scene.anchors.offsets[used].any()


def test_offsets_take_what_positions_lose() -> None:
    """On a grid of a tenth of the scene, Gaussians stay where they were."""
    scene, sensitivity = after()
    config = varied(RoundingConfig(), FIRST_NOISE_LEVELS=0.01)
    moved, steps = quantize_first_frame(scene, sensitivity, config=config, voxel_size=0.1, steps=STEPS)
    assert steps["anchor_positions"] == pytest.approx(0.1)
    lost = (moved.anchors.positions - scene.anchors.positions).abs()
    assert float(lost.max()) > 0.03
    shown = (moved.anchors.positions / STEPS["anchor_positions"]).round() * STEPS["anchor_positions"]
    used = sensitivity.used & (sensitivity.fields["anchor_offsets"].sum(2) > 0)
    means = (scene.anchors.positions[:, None] + scene.anchors.offsets)[used]
    again = (shown[:, None] + moved.anchors.offsets)[used]
    assert float((means - again).abs().max()) < 0.01


def test_a_higher_quality_is_finer_everywhere() -> None:
    _, plain = quantized(0.5)
    _, fine = quantized(0.5, quality=1.0)
    for name in (*SENSITIVITY_FIELDS, "opacity_mlp"):
        assert fine[name] == pytest.approx(plain[name] / 2**0.5)


def test_a_scene_that_no_camera_sees() -> None:
    scene, _ = before()
    away = replace(scene, anchors=replace(scene.anchors, positions=scene.anchors.positions + 1e4))
    sensitivity = estimate_sensitivity(away, RIG, backend=BACKEND, seed=0)
    assert not sensitivity.used.any()
    other, sensitivity = whiten_features(away, sensitivity)
    found, _ = quantize_first_frame(other, sensitivity, config=RoundingConfig(), voxel_size=VOXEL, steps=STEPS)
    assert all(value.isfinite().all() for value in state_of(found).values())


def test_steps_do_not_depend_on_the_number_of_threads() -> None:
    """All later frames depend on the bits of the steps."""
    scene = random_scene(30_000, seed=3)
    g, state = torch.Generator().manual_seed(2), state_of(scene)
    worth: dict[FieldName, torch.Tensor] = {
        name: torch.rand(state[name].shape, generator=g) for name in SENSITIVITY_FIELDS
    }
    used = torch.ones(state["anchor_offsets"].shape[:2], dtype=torch.bool)
    sensitivity = Sensitivity(worth, torch.eye(scene.anchors.features.shape[1], dtype=torch.float64), used)
    found = []
    for threads in (1, 2, 3, 5):
        torch.set_num_threads(threads)
        _, init_steps = quantize_first_frame(scene, sensitivity, config=RoundingConfig(), voxel_size=VOXEL, steps=STEPS)
        found.append(init_steps)
    assert all(other == found[0] for other in found)
