# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest
import torch

from structgstream.codec.packets import check_shapes
from structgstream.errors import StreamError
from structgstream.scene.appearance import with_appearance
from structgstream.scene.state import STATE_TABLE, FieldName, state_of
from tests.support.streams import small_scene


def check(fields: dict[FieldName, torch.Tensor], *, cameras: int = 2) -> None:
    check_shapes(fields, distance_input=True, training_cameras=cameras, where="Packet 1")


@pytest.mark.parametrize(("anchors", "free"), [(0, 0), (3, 0), (0, 2), (3, 2)])
def test_scenes_fit(anchors: int, free: int) -> None:
    check(state_of(small_scene(anchors, free=free)))
    check(state_of(with_appearance(small_scene(anchors, free=free), 1)))


@pytest.mark.parametrize("name", [row.name for row in STATE_TABLE])
def test_one_field_that_does_not_fit_is_named(name: FieldName) -> None:
    scene = replace(with_appearance(small_scene(3, free=2), 2), environment=torch.zeros(4, 3))
    fields = state_of(scene)
    fields[name] = torch.cat([fields[name], fields[name][:1]])
    with pytest.raises(StreamError, match="Packet 1 has (field|an MLP|an environment)") as caught:
        check(fields)
    assert any(part in str(caught.value) for part in ("expected (", "hidden layer", "expected 1, 4 or 9"))


def test_part_of_a_scene_is_checked_as_far_as_it_goes() -> None:
    fields = state_of(small_scene())
    check({"anchor_offsets": fields["anchor_offsets"], "camera_color": fields["camera_color"]})
    with pytest.raises(StreamError, match=r"field camera_color as \(2, 6\) .* expected \(3, 6\)"):
        check({"camera_color": fields["camera_color"]}, cameras=3)


def test_wrong_kinds_of_numbers() -> None:
    fields = state_of(small_scene(free=2))
    for name, value in (("free_births", fields["free_births"].float()), ("free", fields["free"].long())):
        with pytest.raises(StreamError, match=f"field {name} as"):
            check({**fields, name: value})  # type: ignore[dict-item]


def test_anchors_without_gaussians_or_features() -> None:
    fields = state_of(small_scene())
    with pytest.raises(StreamError, match="0 Gaussians and 2 features"):
        check({**fields, "anchor_offsets": torch.zeros(3, 0, 3)})
    with pytest.raises(StreamError, match="2 Gaussians and 0 features"):
        check({**fields, "anchor_features": torch.zeros(3, 0)})


def test_mlps_of_different_hidden_widths() -> None:
    fields = state_of(small_scene())
    inputs, outputs, hidden = 6, 2, 5
    wider = torch.zeros(hidden * (inputs + 1) + outputs * (hidden + 1))
    with pytest.raises(StreamError, match="not the size of the other MLPs"):
        check({**fields, "opacity_mlp": wider})
