# SPDX-License-Identifier: Apache-2.0
import json
import math
import re
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest

from structgstream.data.plane_sweep import DEFAULT_LEVELS
from structgstream.errors import ConfigError
from structgstream.session.presets import (
    DEFAULT_PRESET,
    DEMO_PRESET,
    PAPER_METHOD_PRESET,
    PRESETS,
    RENAMED,
    WITHDRAWN,
    StreamConfig,
    completed,
    from_json,
    renamed,
    to_json,
)
from structgstream.training.frame0.fit import InitialRates


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
    assert online.patching.iteration < online.iterations


@pytest.mark.parametrize("name", ["paper-n3dv", "paper-meetroom", "paper-immersive"])
def test_paper_presets_keep_the_published_rates(name: str) -> None:
    initial = PRESETS[name].initial
    assert initial.rates == InitialRates()
    assert (initial.iterations, initial.schedule_iterations, initial.seed_voxels) == (4000, 30_000, 1)


@pytest.mark.parametrize("name", PRESETS)
def test_a_configuration_comes_back_from_a_header(name: str) -> None:
    assert from_json(json.loads(json.dumps(to_json(PRESETS[name])))) == PRESETS[name]


def test_a_configuration_of_an_older_version_has_the_defaults_of_what_it_lacks() -> None:
    values = to_json(PRESETS["compact"])
    del values["rate"], values["online"]["motion_prior"], values["initial"]["rates"]
    found = from_json(values)
    assert (found.rate, found.online.motion_prior) == (StreamConfig().rate, StreamConfig().online.motion_prior)
    assert found.initial.rates == InitialRates()
    assert found.points == PRESETS["compact"].points
    assert completed(values) == to_json(found)
    other = {"method": "another", "seed": 1}
    assert completed(other) == other


def with_former_names(config: StreamConfig) -> dict[str, Any]:
    """The configuration as an earlier version wrote it: a field that had another name has that."""
    values = json.loads(json.dumps(to_json(config)))
    for path, name in sorted(RENAMED.items(), key=lambda item: -item[0].count(".")):
        *parents, former = path.split(".")
        group = group_at(values, renamed(".".join(parents)))
        if name in group:
            group[former] = group.pop(name)
    rates = values["initial"]["rates"]
    # Headers are stored with sorted keys.
    values["initial"]["rates"] = {name: {"final": last, "initial": first} for name, (first, last) in rates.items()}
    return values


def group_at(values: dict[str, Any], path: str) -> dict[str, Any]:
    for part in path.split("."):
        values = values[part]
    return values


@pytest.mark.parametrize("name", PRESETS)
def test_former_names_of_fields_are_read(name: str) -> None:
    values = with_former_names(PRESETS[name])
    assert {"births", "start"} < values["online"].keys()
    assert from_json(values) == PRESETS[name]


def test_fields_of_mechanisms_that_are_gone_are_ignored() -> None:
    values = with_former_names(PRESETS["compact"])
    for path in WITHDRAWN:
        group, _, name = path.rpartition(".")
        group_at(values, group)[name] = 0.5
    assert from_json(values) == PRESETS["compact"]


def test_a_former_field_is_ignored_if_it_has_the_value_of_its_constant_or_its_group_is_off() -> None:
    values = json.loads(json.dumps(to_json(PRESETS["compact"])))
    values["denoising"] |= {"threshold": 0.024, "reach_pixels": 3}
    values["rate"]["window_seconds"] = 1
    values["points"]["sweep_levels"] = [
        {**vars(level), "agreement": [1.0, 0.01], "planes": [48, 128]} for level in DEFAULT_LEVELS
    ]
    assert from_json(values) == PRESETS["compact"]
    values["initial"]["rates"]["offsets"] = {"initial": 0.02, "final": 0.001}
    values["initial"]["rates"]["positions"] = {"initial": 0.0, "final": 0.0}
    values["initial"]["depth_distortion"]["every"] = 4
    assert from_json(values) == PRESETS["compact"]
    values["environment"]["degree"] = 1
    with pytest.raises(ConfigError, match=r"environment.degree = 1, which is always 2 in this version"):
        from_json(values)
    values["environment"]["enabled"] = False
    assert not from_json(values).environment.enabled


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ({"later": 1}, "the field later, which this version of structgstream does not have"),
        ({"online": {"spawn": {"later": 1}}}, "the field online.spawn.later"),
        ({"seed": "0"}, "seed is '0'; expected a whole number"),
        ({"seed": True}, "seed is True; expected a whole number"),
        ({"online": 5}, "of another kind than its field"),
        ({"online": {"iterations": None}}, "iterations is None; expected a whole number"),
    ],
)
def test_what_no_field_can_have_is_refused_by_its_reason(edit: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        from_json(to_json(PRESETS["compact"]) | edit)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("online.iterations", -5),
        ("online.mean_of_last", 2.0),
        ("online.motion_prior", math.nan),
        ("online.motion.picture_scale", 0.0),
        ("initial.rates.offsets", (-1e-3, 0.0)),
        ("key_interval_seconds", math.inf),
        ("rate.target_mbits", -1.0),
        ("seed", -1),
    ],
)
def test_values_out_of_range_are_refused_by_the_path_of_the_field(path: str, value: object) -> None:
    def edited(config: Any, names: list[str]) -> Any:
        first, *others = names
        return replace(config, **{first: edited(getattr(config, first), others) if others else value})

    with pytest.raises(ConfigError, match=re.escape(path) if path != "seed" else "seed"):
        edited(PRESETS["compact"], path.split("."))
