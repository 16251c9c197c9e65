# SPDX-License-Identifier: Apache-2.0
import json
import math
import re
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest

from structgstream.errors import ConfigError
from structgstream.session.presets import PRESETS, StreamConfig, completed, from_json, to_json
from structgstream.training.frame0.fit import InitialRates


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


@pytest.mark.parametrize("name", PRESETS)
def test_a_configuration_is_plain_json_and_comes_back_from_a_header(name: str) -> None:
    values = json.loads(json.dumps(to_json(PRESETS[name]), allow_nan=False))
    assert values == to_json(PRESETS[name])
    assert from_json(values) == PRESETS[name]


def test_a_configuration_has_the_defaults_of_what_a_header_lacks() -> None:
    values = to_json(PRESETS["compact"])
    del values["rate"], values["online"]["motion_prior"], values["initial"]["rates"]
    found = from_json(values)
    assert (found.rate, found.online.motion_prior) == (StreamConfig().rate, StreamConfig().online.motion_prior)
    assert found.initial.rates == InitialRates()
    assert found.points == PRESETS["compact"].points
    assert completed(values) == to_json(found)
    other = {"method": "another", "seed": 1}
    assert completed(other) == other


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ({"later": 1}, "the field later, which this version of structgstream does not have"),
        ({"online": {"spawn": {"later": 1}}}, "the field online.spawn.later"),
        ({"seed": "0"}, "seed is '0'; expected a whole number"),
        ({"seed": True}, "seed is True; expected a whole number"),
        ({"online": 5}, "of another kind than its field"),
        ({"codec": "zip"}, "of another kind than its field"),
        ({"online": {"dynamic": "free"}}, "of another kind than its field"),
        ({"online": {"dynamic": ["free", 1]}}, "of another kind than its field"),
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
        ("rate.target_mbits", 0.0),
        ("seed", -1),
    ],
)
def test_values_out_of_range_are_refused_by_the_path_of_the_field(path: str, value: object) -> None:
    def edited(config: Any, names: list[str]) -> Any:
        first, *others = names
        return replace(config, **{first: edited(getattr(config, first), others) if others else value})

    with pytest.raises(ConfigError, match=re.escape(path) if path != "seed" else "seed"):
        edited(PRESETS["compact"], path.split("."))
