# SPDX-License-Identifier: Apache-2.0
"""The player as a widget, and the example notebook, run in a kernel of its own."""

import json
import sys
from pathlib import Path

import nbformat
import pytest
import traitlets
from nbclient import NotebookClient

from structgstream.errors import MissingExtraError, StreamError
from structgstream.notebook import Player
from structgstream.serve.pages import bundle
from tests.support.streams import small_stream

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "player.ipynb"
STREAM = small_stream(3)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "s.sgs"
    path.write_bytes(STREAM)
    return path


def test_a_file_and_its_bytes_are_the_same_widget(file: Path) -> None:
    for player in (Player(file), Player(str(file)), Player(STREAM)):
        state = player.get_state()
        assert state["stream"] == STREAM
        assert state["height_pixels"] == 480
        assert state["_esm"].startswith(bundle())
        assert "structgstream-player" in state["_esm"]
        player.close()


def test_other_bytes_and_another_height_are_reported_to_the_browser(file: Path) -> None:
    player = Player(file, height_pixels=200)
    reported: list[str] = []
    player.observe(lambda change: reported.append(change["name"]), ["stream", "height_pixels"])
    player.stream, player.height_pixels = STREAM[:-1], 300
    assert reported == ["stream", "height_pixels"]
    with pytest.raises(traitlets.TraitError):
        player.height_pixels = "tall"  # type: ignore[assignment]


@pytest.mark.parametrize(
    ("stream", "words"),
    [(b"", "is empty"), (b"hello, this is no stream", "is not a structgstream file"), ("no.sgs", "No such file")],
)
def test_what_cannot_be_shown_is_reported(stream: bytes | str, words: str) -> None:
    with pytest.raises(StreamError, match=words):
        Player(stream)


def test_a_missing_extra_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "structgstream.notebook")
    monkeypatch.setitem(sys.modules, "anywidget", None)  # type: ignore[arg-type]
    with pytest.raises(MissingExtraError, match=r"pip install 'structgstream\[notebook\]'"):
        import structgstream.notebook  # noqa: F401


def test_the_example_notebook_runs(tmp_path: Path) -> None:
    (tmp_path / "examples").mkdir()
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "clip.sgs").write_bytes(STREAM)
    notebook = nbformat.read(EXAMPLE, as_version=4)
    client = NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path / "examples")}})
    client.execute()
    shown, printed = (cell["outputs"] for cell in notebook.cells if cell["cell_type"] == "code")
    assert "application/vnd.jupyter.widget-view+json" in shown[0]["data"]
    assert printed[0]["text"].startswith("3 frames of 30 a second; frame 1 takes ")
    states = notebook.metadata["widgets"]["application/vnd.jupyter.widget-state+json"]["state"].values()
    (player,) = (state for state in states if state["model_module"] == "anywidget")
    (stream,) = (buffer for buffer in player["buffers"] if buffer["path"] == ["stream"])
    assert 0 < len(stream["data"]) < 4 * len(STREAM) / 3  # the two frames that were left


def test_the_example_notebook_is_kept_without_outputs() -> None:
    cells = json.loads(EXAMPLE.read_text())["cells"]
    assert not [cell for cell in cells if cell["cell_type"] == "code" and (cell["outputs"] or cell["execution_count"])]
