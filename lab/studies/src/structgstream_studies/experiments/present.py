# SPDX-License-Identifier: Apache-2.0
"""Whether a result was made with the configuration that its row has today.

A table is refused if it was not, unless its marker accepts the difference (``documents.py``); the table then says so.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from structgstream.errors import ConfigError
from structgstream.session.presets import DEFAULT_PRESET, PRESETS, to_json
from structgstream_studies.experiments.effects import effects
from structgstream_studies.experiments.rate_distortion import qualities
from structgstream_studies.experiments.readings import READINGS
from structgstream_studies.experiments.results import Result, round_floats
from structgstream_studies.experiments.variants import FULL_METHODS, variants

SETTLED: Mapping[str, Any] = {
    "initial.losses.offset_distance_reading": "scaled",
    "initial.depth_distortion.weight": 0.0,
    "depth_distortion.weight": 0.0,
    "online.extra_iterations": 0.0,
}
"""Fields that some programs lack, with the value at which the others do the same: it makes no difference."""


@dataclass(frozen=True)
class Former:
    """How recorded configurations differ from those of today.

    Args:
        changed: for each field that both have, by its path: its recorded values and those of today, as text.
        gone: number of fields that only recorded configurations have.
        new: number of fields that only today's have.
        commits: of the programs that recorded them.
    """

    changed: Mapping[str, str]
    gone: int
    new: int
    commits: tuple[str, ...]

    def __bool__(self) -> bool:
        return bool(self.changed or self.gone or self.new)

    def sentence(self) -> str:
        """What a reader of the table has to know."""
        values = "".join(f" `{path}` {text};" for path, text in self.changed.items())
        return (
            f"**Of a former program** (commit {', '.join(self.commits)}), not run again with the present one:{values} "
            f"{self.gone} fields of its configuration are gone, {self.new} are new."
        )


@cache
def present_configs() -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    """Today's configurations of every row of a table, as a value for each path, by the row's key and by the method that
    it edits (``variants.FULL_METHODS``)."""
    from structgstream_studies.peers.methods import METHODS

    compact, found = PRESETS[DEFAULT_PRESET], {}
    for name, full in FULL_METHODS.items():
        configs: dict[str, Any] = {key: method.config for key, method in METHODS.items()} | dict(PRESETS)
        configs |= {key: reading.edit(full) for key, reading in READINGS.items()}
        rows = (variants(full), effects(compact, paper=full), qualities(compact))
        configs |= {key: row.config for table in rows for key, row in table.items()}
        for key, config in configs.items():
            found.setdefault(key, {})[name] = _fields(round_floats(to_json(config)))
    return found


def full_method(results: Iterable[Result]) -> str:
    """The method that most ``results`` are edits of: the first that differs least from their configurations."""
    found = [(result.key, _fields(result.identity["config"])) for result in results]
    known = [(present_configs()[key], then) for key, then in found if key in present_configs()]
    return min(FULL_METHODS, key=lambda name: sum(_differences(now[name], then) for now, then in known))


def _differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> int:
    missing = object()
    return sum(one.get(path, missing) != other.get(path, missing) for path in one.keys() | other.keys())


def former(results: Iterable[Result]) -> Former:
    """How the configurations of ``results`` differ from today's; those of keys that no table has are left out."""
    values: dict[str, dict[str, None]] = {}
    commits: dict[str, None] = {}
    gone: set[str] = set()
    new: set[str] = set()
    results = list(results)
    name = full_method(results)
    for result in results:
        if result.key not in present_configs():
            continue
        now = present_configs()[result.key][name]
        then = _fields(result.identity["config"])
        changed = [path for path in then.keys() & now.keys() if then[path] != now[path]]
        for path in changed:
            values.setdefault(path, {})[f"{_text(then[path])}, now {_text(now[path])}"] = None
        gone |= then.keys() - now.keys()
        new |= now.keys() - then.keys()
        if changed or then.keys() != now.keys():
            commits[str(result.trained_by.get("commit") or "not recorded")] = None
    return Former(
        {path: " or ".join(values[path]) for path in sorted(values)}, len(gone), len(new), tuple(sorted(commits))
    )


def remark(results: Iterable[Result], *, accepted: Iterable[str] | None, table: str) -> str:
    """The sentence below a table, empty if its results are of today's configurations.

    Args:
        results: those that the table shows.
        accepted: paths of fields that may differ besides those that only one program has; None if nothing may.
        table: its name in the error.

    Raises:
        ConfigError: a difference is not accepted, or one is accepted that does not exist.
    """
    found = former(results)
    if accepted is None:
        if found:
            paths = " ".join(["former", *found.changed])
            raise ConfigError(
                f"The results of the table {table!r} are not of today's configuration. {found.sentence()} Run them "
                f"again, remove the table, or let its marker say so: <!-- {table} {paths} -->."
            )
        return ""
    names = set(accepted)
    if not found or names != set(found.changed):
        differ = ", ".join(found.changed) or "no field that both have"
        raise ConfigError(
            f"The marker of the table {table!r} accepts {', '.join(sorted(names)) or 'no field that both have'}; "
            f"{differ} differ{'s' if len(found.changed) < 2 else ''} from today's configuration."
        )
    return found.sentence()


def _fields(config: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, Mapping):
            found |= _fields(value, f"{before}{name}.")
        elif (before or name != "seed") and SETTLED.get(before + name) != value:
            found[before + name] = value
    return found


def _text(value: Any) -> str:
    return f"[{', '.join(map(str, value))}]" if isinstance(value, list) else str(value)
