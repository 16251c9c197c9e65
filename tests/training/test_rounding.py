# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera, CameraRig
from structgstream.codec.fields.packet_fields import CODABLE, dequantize_state, quantize_state
from structgstream.codec.fields.quantization import LARGEST, round_straight_through
from structgstream.scene.appearance import with_appearance
from structgstream.scene.state import FieldName, ParameterName, parameters_of, state_of
from structgstream.training.parameters import Parameters, RoundingConfig, parameters_of_fields, pixel_size
from tests.support.rigs import arc_rig, random_scene
from tests.support.varied import varied


def test_rounding_is_drawn_and_not_felt() -> None:
    value = torch.tensor([0.1, 0.26, -0.9, 0.0], requires_grad=True)
    found = round_straight_through(value, 0.25)
    assert found.tolist() == [0.0, 0.25, -1.0, 0.0]
    (found * torch.tensor([1.0, 2.0, 3.0, 4.0])).sum().backward()
    assert value.grad is not None
    assert value.grad.tolist() == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize("step", [0.013, 1 / 256, 3e-7, 123.456])
def test_a_value_of_a_bin_stays_where_it_is(step: float) -> None:
    """What stands still keeps its bin, frame after frame, up to the last bin that there is."""
    step = float(np.float32(step))
    bins = np.unique(np.rint(np.geomspace(1, LARGEST, 20_000))).astype(np.int64)
    values = torch.from_numpy(bins.astype(np.float32) * np.float32(step))
    assert torch.equal(round_straight_through(values, step), values)
    assert torch.equal(round_straight_through(-values, step), -values)


def test_what_the_trainer_draws_is_what_the_codec_sends() -> None:
    """Both round in float32: the scene of a fit has no other values than those that its bins stand for."""
    scene = with_appearance(random_scene(300, free=40, seed=8), 8)
    known = RoundingConfig().steps(0.0123)
    steps: dict[ParameterName, float] = {name: float(np.float32(step)) for name, step in known.items()}
    parameters = Parameters.of(scene, trained=parameters_of_fields(CODABLE), steps=steps)
    drawn: dict[FieldName, torch.Tensor] = {
        name: value.detach() for name, value in state_of(parameters.scene(scene)).items()
    }
    of_codec: dict[str, float] = {**steps}
    sent = dequantize_state(quantize_state(drawn, CODABLE, of_codec), CODABLE, of_codec)
    for name, value in sent.items():
        assert torch.equal(value, drawn[name]), name


def test_there_is_a_step_for_everything_that_can_change() -> None:
    steps = varied(RoundingConfig(), POSITION_PIXELS=0.5).steps(0.01)
    assert steps.keys() == {p.name for p in parameters_of(CODABLE) if p.step}
    assert steps["anchor_positions"] == steps["free_means"] == 0.005
    assert all(step > 0 for step in steps.values())


@pytest.mark.parametrize("quality", [-2.0, -0.5, 1.0, 3.0])
def test_one_more_of_quality_is_twice_as_fine_and_a_quarter_as_dear(quality: float) -> None:
    plain, other = RoundingConfig(rate_weight=3e-4), RoundingConfig(rate_weight=3e-4, quality=quality)
    ratios = {name: step / plain.steps(0.01)[name] for name, step in other.steps(0.01).items()}
    wanted = dict.fromkeys(plain.steps(0.01), 2.0**-quality)
    mlps = ("opacity_mlp", "color_mlp", "covariance_mlp")
    wanted |= dict.fromkeys(mlps, 2.0 ** (-quality / 2))
    assert ratios == pytest.approx(wanted)
    assert {other.steps(0.01)[name] for name in mlps} == {other.at_quality("first_weight_step")}, "frame 0's"
    assert other.resolved_rate_weight == pytest.approx(3e-4 * 4.0**-quality)


def test_a_pixel_is_as_large_as_it_is_seen() -> None:
    """On the arc, at distance 3 with 40 pixels of focal length, a pixel covers 3 / 40."""
    cameras = _cameras(arc_rig(5, radius=3.0))
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0)) * 0.05
    distance = math.hypot(3.0, 0.3)
    assert pixel_size(points, cameras) == pytest.approx(distance / 40, rel=0.01)
    behind = torch.cat([points, torch.full((1000, 3), 100.0)])
    assert pixel_size(behind, cameras) == pytest.approx(distance / 40, rel=0.01), "what no camera sees does not count"
    wider = arc_rig(5, radius=6.0)
    assert pixel_size(points, _cameras(wider)) == pytest.approx(math.hypot(6.0, 0.3) / 40, rel=0.01)
    assert pixel_size(behind[400:], cameras) is None


def _cameras(rig: CameraRig) -> list[Camera]:
    return [rig[name] for name in rig.training]
