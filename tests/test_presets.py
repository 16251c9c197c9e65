# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import fields, is_dataclass

import pytest

from structgstream.errors import ConfigError
from structgstream.presets import DEFAULT_PRESET, DEMO_PRESET, PAPER_METHOD_PRESET, PRESETS, from_json, to_json
from structgstream.training.initial import InitialRates


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_plain_json(name: str) -> None:
    config = PRESETS[name]
    assert json.loads(json.dumps(to_json(config), allow_nan=False)) == to_json(config)


def test_the_named_defaults_exist() -> None:
    assert DEFAULT_PRESET in PRESETS
    assert DEMO_PRESET in PRESETS
    assert PRESETS[PAPER_METHOD_PRESET].codec == "raw" != PRESETS[DEFAULT_PRESET].codec


def frozen(value: object) -> bool:
    if not is_dataclass(value):
        return True
    parameters = type(value).__dataclass_params__  # pyright: ignore[reportAttributeAccessIssue] -- of every dataclass
    return parameters.frozen and all(frozen(getattr(value, f.name)) for f in fields(value))


def test_configurations_are_values() -> None:
    assert all(frozen(config) for config in PRESETS.values())


@pytest.mark.parametrize("name", PRESETS)
def test_schedules_fit_their_length(name: str) -> None:
    initial, online = PRESETS[name].initial, PRESETS[name].online
    assert initial.coarse_iterations + initial.medium_iterations < initial.iterations
    assert initial.growth.collect_from <= initial.growth.start < initial.growth.last(initial.iterations)
    assert initial.growth.room_until <= initial.growth.last(initial.iterations)
    assert all(at < initial.iterations for at in initial.growth.contribution_at)
    assert online.patching.iteration < online.iterations


@pytest.mark.parametrize("name", ["paper-n3dv", "paper-meetroom", "paper-immersive"])
def test_paper_presets_keep_the_published_rates(name: str) -> None:
    initial = PRESETS[name].initial
    assert initial.rates == InitialRates()
    assert (initial.iterations, initial.schedule_iterations, initial.seed_voxels) == (4000, 30_000, 1)


@pytest.mark.parametrize("name", PRESETS)
def test_a_configuration_comes_back_from_a_header(name: str) -> None:
    assert from_json(json.loads(json.dumps(to_json(PRESETS[name])))) == PRESETS[name]


def test_configurations_of_other_versions_are_refused() -> None:
    values = to_json(PRESETS["compact"])
    lacking = {name: value for name, value in values.items() if name != "rate"}
    for other in (values | {"later": 1}, lacking, {"seed": 0}, {"method": "another"}):
        with pytest.raises(ConfigError, match="another version"):
            from_json(other)
