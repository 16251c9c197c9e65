# SPDX-License-Identifier: Apache-2.0
"""Tables of documents are made from results; nothing else of a document changes, and ours are up to date."""

from dataclasses import replace
from pathlib import Path

import pytest

from outcomes import outcome, outcomes
from structgstream.errors import ConfigError, StorageError
from structgstream_studies.experiments.__main__ import main
from structgstream_studies.experiments.documents import MARKED, read_studies, refresh, refresh_text
from structgstream_studies.experiments.results import Result, write_result

LAB = Path(__file__).resolve().parents[3]

TEXT = """# A document

Words before, with a comment. <!-- as people write them -->

<!-- ablation structured ring -->
old
<!-- end -->

Words between | with a bar.

<!-- methods ring -->
<!-- end -->
<!-- readings readings -->
| a | b |
<!-- end -->
<!-- made-by ring -->
<!-- end -->
Words after.
"""


def results() -> dict[str, list[Result]]:
    found = outcomes("full", (30.0, 31.0, 32.0)) + outcomes("without-scaling-factor", (29.8, 30.7, 31.8))
    return {"ring": found, "readings": [outcome("reading-default")], "ring-motion": [outcome("full", psnr=99.25)]}


def write_results(folder: Path) -> None:
    for study, found in results().items():
        for number, result in enumerate(found):
            write_result(folder / study / f"{number}.json", result)


def marked_parts(text: str) -> list[str]:
    return [match[0] for match in MARKED.finditer(text)]


def test_marked_parts_are_made_from_results() -> None:
    ablation, methods, readings, made_by = marked_parts(refresh_text(TEXT, results()))
    assert "| w/o scaling factor | 30.77 ± 1.00 | -0.23 ± 0.06 | 33.53 | -0.28 | reproduced |" in ablation
    assert "| Struct-GStream (rig) | 3 | 31.00 ± 1.00 |" in methods
    assert "| - | the defaults | - | 30.00 |" in readings
    assert "Trained at commit abc1234 on a processor, 1 of 4 cores a run, torch 2.0." in made_by
    assert "ring (0123456789ab), 3 frames of 64x48, 5 training cameras, held out a, b." in made_by
    assert "old" not in ablation
    assert "99.25" not in ablation + methods + readings + made_by


COMPACT = """<!-- effects ring -->
<!-- end -->
<!-- rates ring -->
<!-- end -->
<!-- rate-plot ring -->
<!-- end -->
<!-- bd-rate ring other -->
<!-- end -->
"""


def compact_results() -> dict[str, list[Result]]:
    ring = [
        outcome(key, psnr=30.0 + i, mean={"online_bytes": 1e4 * 2**i})
        for i, key in enumerate(("quality-m1", "compact", "quality-p1"))
    ]
    other = [replace(result, mean={**result.mean, "online_bytes": 2 * result.mean["online_bytes"]}) for result in ring]
    return {"ring": [*ring, outcome("full", psnr=31.0, mean={"online_bytes": 1e6})], "other": other}


def test_parts_about_the_compact_stream() -> None:
    effects, rates, plot, differences = marked_parts(refresh_text(COMPACT, compact_results()))
    assert "| compact | 1 | 31.00 | - | - | - | - | - | 20.0 |" in effects
    assert "| the paper's method (rig) | 1 | 31.00 | - | +0.00 | - | - | - | 1000.0 |" in effects
    assert "| compact, quality +1 | 1 | 32.00 | - | - | 40.0 | 9.60 | - |" in rates
    assert "| paper mode, PSNR | 1 | 1000.0 | 31.00 | 20.0 | -98.0 | - | - |" in rates
    assert "\n- paper mode, PSNR: Its 1000.0 KB a frame are not on the curve, which ends at 40.0 KB.\n" in rates
    assert "](images/ring-rates.png)" in plot
    assert "| PSNR | 1 | -50.0 | +1.00 |" in differences


def test_without_results_of_the_compact_stream_tables_are_empty() -> None:
    effects, rates, plot, differences = marked_parts(refresh_text(COMPACT, {}))
    assert effects.count("\n|") == 2  # head and rule
    assert "| compact, quality -2 | - | - |" in rates
    assert "against" not in rates
    assert "No result yet." in plot
    assert "No result yet." in differences
    assert refresh_text(refresh_text(COMPACT, {}), {}) == refresh_text(COMPACT, {})


def test_the_picture_of_the_rates_is_drawn_beside_the_document(tmp_path: Path) -> None:
    for study, found in compact_results().items():
        for result in found:
            write_result(tmp_path / "r" / study / f"{result.key}.json", result)
    (tmp_path / "d.md").write_text(COMPACT)
    refresh([tmp_path / "d.md"], tmp_path / "r")
    assert [path.name for path in (tmp_path / "images").iterdir()] == ["ring-rates.png"]


def test_the_rest_of_a_document_stays_and_a_second_time_changes_nothing() -> None:
    once = refresh_text(TEXT, results())
    assert MARKED.sub("@", once) == MARKED.sub("@", TEXT)
    assert MARKED.sub("@", TEXT).count("@") == 4
    assert refresh_text(once, results()) == once
    assert refresh_text("No table.\n", results()) == "No table.\n"


def test_a_capture_without_results_has_tables_without_numbers() -> None:
    ablation, methods, _, made_by = marked_parts(refresh_text(TEXT, {}))
    assert "33.53" in ablation
    assert "±" not in ablation + methods
    assert "No result yet." in made_by


@pytest.mark.parametrize(
    ("marker", "words"),
    [
        ("<!-- ablations structured ring -->", "ablations structured ring; known are ablation, methods"),
        ("<!-- ablation ring -->", "ablation ring"),
        ("<!-- ablation colours ring -->", "'colours'; there are structured"),
        ("<!-- methods ring arc -->", "methods ring arc"),
    ],
)
def test_a_marker_that_asks_for_something_unknown(marker: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        refresh_text(f"{marker}\n<!-- end -->\n", results())


@pytest.mark.parametrize(
    "text",
    [
        "<!-- methods ring -->\n| a |\n\nwords\n",
        "<!-- methods ring -->\nwords\n<!-- made-by ring -->\n<!-- end -->\n",
        "<!-- methods ring --> <!-- end -->\n",
    ],
)
def test_a_table_without_an_end_is_reported_and_swallows_no_words(text: str) -> None:
    with pytest.raises(ConfigError, match="does not end"):
        refresh_text(text, results())


def test_files_that_change_are_named_and_others_are_left_alone(tmp_path: Path) -> None:
    write_results(tmp_path / "results")
    table, words = tmp_path / "table.md", tmp_path / "words.md"
    table.write_text(TEXT)
    words.write_text("No table.\n")
    written = words.stat().st_mtime_ns
    assert refresh([table, words], tmp_path / "results") == [table]
    assert table.read_text() == refresh_text(TEXT, results())
    assert words.stat().st_mtime_ns == written
    assert refresh([table, words], tmp_path / "results") == []
    (tmp_path / "results" / "ring" / "other.json").write_text("{}")
    with pytest.raises(StorageError, match=r"other\.json is not a result"):
        refresh([table], tmp_path / "results")


def test_the_module_renews_documents_and_says_which(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_results(tmp_path / "r")
    document = tmp_path / "d.md"
    document.write_text(TEXT)
    assert main([str(tmp_path / "r"), str(document)]) == 0
    assert "d.md" in capsys.readouterr().out
    assert "31.00 ± 1.00" in document.read_text()
    document.write_text("<!-- metods ring -->\n<!-- end -->\n")
    assert main([str(tmp_path / "r"), str(document)]) == 1
    assert "metods ring" in capsys.readouterr().err
    assert main([str(tmp_path / "r"), str(tmp_path / "no.md")]) == 1
    assert main([str(tmp_path / "r")]) == 2


def test_the_tables_of_our_notes_are_those_of_our_results() -> None:
    found = read_studies(LAB / "results")
    for path in sorted((LAB / "notes").glob("*.md")):
        text = path.read_text()
        assert refresh_text(text, found) == text, f"run: python -m structgstream_studies.experiments lab/results {path}"
