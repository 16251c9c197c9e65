# SPDX-License-Identifier: Apache-2.0
"""Generates the tables of documents from results: text between two markers is replaced.

A marker is a comment of Markdown on a line of its own::

    <!-- ablation structured basketball -->
    ...
    <!-- end -->

with ``ablation TABLE STUDY``, ``methods STUDY``, ``folds STUDY OTHER``, ``cited DATA``, ``readings STUDY``, ``effects
STUDY``, ``rates STUDY``, ``bd-rate STUDY OTHER`` and ``made-by STUDY`` for text, and ``curves TABLE
STUDY``, ``plot STUDY`` and ``rate-plot STUDY`` for pictures, which go to ``images/`` beside the document. A study is a
folder of results of one capture and one full method, named after the capture or the study.

A table of results that are not of today's configurations is refused (``present.py``), unless its marker ends with
``former`` and the fields that differ: ``<!-- readings STUDY former initial.growth.max_anchors -->``. It then says so.
"""

import re
from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path

from structgstream.errors import ConfigError
from structgstream_studies.experiments.cited import cited_sheet, cited_words
from structgstream_studies.experiments.effects import effects_sheet
from structgstream_studies.experiments.figures import write_comparison, write_curves
from structgstream_studies.experiments.folds import folds_sheet
from structgstream_studies.experiments.present import full_method, remark
from structgstream_studies.experiments.rate_distortion import (
    bd_sheet,
    bullet_list,
    curve_titles,
    rates_sheet,
    versus_sheet,
)
from structgstream_studies.experiments.rate_figures import write_rates
from structgstream_studies.experiments.readings import READINGS, readings_sheet
from structgstream_studies.experiments.results import Result, read_results
from structgstream_studies.experiments.sheets import ablation_sheet, comparison_sheet, markdown
from structgstream_studies.experiments.studies import (
    COMPARED,
    effect_titles,
    method_key,
    method_titles,
    variant_titles,
)
from structgstream_studies.experiments.variants import TABLES

Studies = Mapping[str, Sequence[Result]]
"""Results by the name of their folder."""

MARKED = re.compile(r"<!-- (?P<what>[a-z-]+)(?P<rest>(?: [\w.-]+)*) -->\n(?:(?!<!-- ).)*<!-- end -->", re.DOTALL)


def refresh(documents: Sequence[Path], results: Path) -> list[Path]:
    """Renews the tables of ``documents`` from the results below a folder; returns the documents that changed.

    Raises:
        ConfigError: a marker is unknown.
        StorageError: a result cannot be read.
    """
    found = read_studies(results)
    changed = []
    for path in documents:
        old = path.read_text()
        new = refresh_text(old, found)
        if new != old:
            path.write_text(new)
            changed.append(path)
        for match in MARKED.finditer(new):
            _draw(match["what"], match["rest"].split(), found, folder=path.parent / "images")
    return changed


def read_studies(folder: Path) -> dict[str, list[Result]]:
    """The results in each folder of ``folder``, by its name.

    Raises:
        StorageError: a file cannot be read or is something else.
    """
    return {path.name: read_results(path) for path in sorted(folder.iterdir()) if path.is_dir()}


def _draw(what: str, words: Sequence[str], studies: Studies, *, folder: Path) -> None:
    if what not in _PICTURES:
        return
    mine = studies.get(words[-1], ())
    if mine and what == "curves":
        keys = list(TABLES[words[0]].rows)
        shown = [result for result in mine if result.key in keys]
        write_curves(folder / f"{words[1]}-{words[0]}.png", shown, keys=keys, titles=variant_titles())
    elif mine and what == "rate-plot":
        write_rates(folder / f"{words[0]}-rates.png", mine)
    elif mine:
        write_comparison(folder / f"{words[0]}-methods.png", mine, titles=_method_titles())


def refresh_text(text: str, studies: Studies) -> str:
    """``text`` with every marked part made from the results of ``studies``.

    Raises:
        ConfigError: a marker is unknown or has no end, or the results are not of today's configurations.
    """

    def renewed(match: re.Match[str]) -> str:
        what, words = match["what"], match["rest"].split()
        rest, accepted = _before_former(words) if what in _SHOWN else (words, None)
        if what not in _MAKERS or len(rest) != _MAKERS[what][0]:
            raise ConfigError(f"A document asks for {match['what']}{match['rest']}; known are {', '.join(_MAKERS)}.")
        content = _MAKERS[what][1](rest, studies)
        if what in _SHOWN and (
            words := remark(_shown(what, rest, studies), accepted=accepted, table=_named(what, rest))
        ):
            content += f"\n{words}\n"
        return f"<!-- {what}{match['rest']} -->\n{content}<!-- end -->"

    new = MARKED.sub(renewed, text)
    begun = sum(len(re.findall(f"<!-- {what} .*-->", text)) for what in _MAKERS)
    if begun > len(MARKED.findall(text)):
        raise ConfigError(
            "A document begins a table that it does not end; put <!-- end --> on a line of its own below."
        )
    return new


def _named(what: str, rest: Sequence[str]) -> str:
    return " ".join([what, *rest])


def _before_former(words: list[str]) -> tuple[list[str], list[str] | None]:
    """The words of a marker before ``former``, and the fields after it; None without it."""
    if "former" not in words:
        return words, None
    place = words.index("former")
    return words[:place], words[place + 1 :]


def _shown(what: str, words: Sequence[str], studies: Studies) -> list[Result]:
    """The results that a table shows."""
    rows = _SHOWN[what](words)
    names = words[1:] if what == "ablation" else words
    return [result for name in names for result in studies.get(name, ()) if result.key in rows]


def _ablation(words: Sequence[str], studies: Studies) -> str:
    table, study = words
    if table not in TABLES:
        raise ConfigError(f"A document asks for the ablation {table!r}; there are {', '.join(TABLES)}.")
    shown = _shown("ablation", words, studies)
    named = f"\nThe full method is {full_method(shown)}.\n" if shown else ""
    return markdown(ablation_sheet(TABLES[table], studies.get(study, ()), titles=variant_titles())) + named


def _methods(words: Sequence[str], studies: Studies) -> str:
    return markdown(comparison_sheet(studies.get(words[0], ()), titles=_method_titles(), scores=COMPARED))


def _folds(words: Sequence[str], studies: Studies) -> str:
    return markdown(folds_sheet([studies.get(word, ()) for word in words], titles=_method_titles()))


def _cited(words: Sequence[str], _: Studies) -> str:
    sheet = cited_sheet(words[0])
    return f"{cited_words(words[0])}\n{markdown(sheet)}"


def _method_titles() -> dict[str, str]:
    return {method_key(name): title for name, title in method_titles().items()}


def _curves(words: Sequence[str], studies: Studies) -> str:
    return f"![Scores over the frames of {words[1]}](images/{words[1]}-{words[0]}.png)\n"


def _plot(words: Sequence[str], studies: Studies) -> str:
    return f"![Quality against bytes and seconds, {words[0]}](images/{words[0]}-methods.png)\n"


def _effects(words: Sequence[str], studies: Studies) -> str:
    return markdown(effects_sheet(studies.get(words[0], ()), titles=effect_titles()))


def _rates(words: Sequence[str], studies: Studies) -> str:
    """The points of the curve, and their comparison with other methods if there are results."""
    mine = studies.get(words[0], ())
    versus, remarks = versus_sheet(mine)
    return markdown(rates_sheet(mine)) + (f"\n{markdown(versus)}{bullet_list(remarks)}" if versus.rows else "")


def _bd_rate(words: Sequence[str], studies: Studies) -> str:
    one, other = (studies.get(word, ()) for word in words)
    if not one or not other:
        return "No result yet.\n"
    sheet, remarks = bd_sheet(one, other)
    return markdown(sheet) + bullet_list(remarks)


def _rate_plot(words: Sequence[str], studies: Studies) -> str:
    if not studies.get(words[0]):
        return "No result yet.\n"
    return f"![Quality against bytes, {words[0]}](images/{words[0]}-rates.png)\n"


def _readings(words: Sequence[str], studies: Studies) -> str:
    return markdown(readings_sheet(studies.get(words[0], ())))


def _made_by(words: Sequence[str], studies: Studies) -> str:
    """Commits, machines and pictures of the results, in a sentence each."""
    mine = studies.get(words[0], ())
    if not mine:
        return "No result yet.\n"
    commits = sorted({str(result.trained_by.get("commit")) for result in mine})
    machines = sorted({_machine(result.trained_by) for result in mine})
    pictures = sorted({_pictures(result.identity["capture"]) for result in mine})
    return f"Trained at commit {', '.join(commits)} on {'; '.join(machines)}. Pictures: {'; '.join(pictures)}.\n"


def _machine(facts: Mapping[str, object]) -> str:
    where = facts.get("gpu") or facts.get("cpu")
    return f"{where}, {facts.get('threads')} of {facts.get('cores')} cores a run, torch {facts.get('torch')}"


def _pictures(capture: Mapping[str, object]) -> str:
    sizes = ", ".join(f"{width}x{height}" for width, height in capture["sizes"])  # type: ignore[attr-defined]
    held_out = ", ".join(capture["held_out"])  # type: ignore[arg-type]
    return (
        f"{capture['name']} ({str(capture['fingerprint'])[:12]}), {capture['frames']} frames of {sizes}, "
        f"{capture['training_cameras']} training cameras, held out {held_out}"
    )


_MAKERS: Mapping[str, tuple[int, Callable[[Sequence[str], Studies], str]]] = {
    "ablation": (2, _ablation),
    "methods": (1, _methods),
    "folds": (2, _folds),
    "cited": (1, _cited),
    "readings": (1, _readings),
    "effects": (1, _effects),
    "rates": (1, _rates),
    "bd-rate": (2, _bd_rate),
    "made-by": (1, _made_by),
    "curves": (2, _curves),
    "plot": (1, _plot),
    "rate-plot": (1, _rate_plot),
}
_PICTURES = ("curves", "plot", "rate-plot")
_SHOWN: Mapping[str, Callable[[Sequence[str]], Container[str]]] = {
    "ablation": lambda words: TABLES[words[0]].rows,
    "methods": lambda _: _method_titles(),
    "folds": lambda _: _method_titles(),
    "readings": lambda _: READINGS,
    "effects": lambda _: effect_titles(),
    "rates": lambda _: curve_titles(),
    "bd-rate": lambda _: curve_titles(),
}
"""Keys of the rows of each table of results."""
