# SPDX-License-Identifier: Apache-2.0
"""The documentation site: every page is in its navigation, links lead where they led, every public name has a place."""

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

import structgstream

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def hooks() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "tools" / "site" / "hooks.py"))


@pytest.mark.skipif(not DOCS.is_dir(), reason="this working copy has no docs/ folder")
def test_the_navigation_lists_every_page(hooks: dict[str, Any]) -> None:
    nav = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2].partition("\n\n")[0]
    pages = re.findall(r": ([\w-]+\.md)$", nav, re.MULTILINE)
    written = [path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")]
    assert sorted(pages) == sorted([*written, *hooks["DOCUMENTS"].values(), hooks["API"]])


def test_the_reference_has_every_public_name_once(hooks: dict[str, Any]) -> None:
    names = hooks["public_names"]((ROOT / "src" / "structgstream" / "__init__.py").read_text())
    assert names == list(structgstream.__all__)
    page = hooks["api_page"](names)
    assert sorted(re.findall(r"^::: structgstream\.(\w+)$", page, re.MULTILINE)) == sorted(names)
    assert page.index("## Functions") < page.index("open_stream") < page.index("## Classes") < page.index("Session")
    assert page.index("Session") < page.index("## Constants") < page.index("PRESETS")


def test_a_module_without_names_is_refused(hooks: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="no __all__"):
        hooks["public_names"]("names = []")


@pytest.mark.parametrize(
    ("target", "source", "page", "wanted"),
    [
        ("docs/method.md#what-rig-changes", "README.md", "index.md", "method.md#what-rig-changes"),
        ("docs/images/clip.jpg", "README.md", "index.md", "images/clip.jpg"),
        ("ARCHITECTURE.md", "README.md", "index.md", "architecture.md"),
        ("../README.md#use-it", "docs/player.md", "player.md", "index.md#use-it"),
        ("entropy.md", "docs/method.md", "method.md", "entropy.md"),
        ("#measured", "README.md", "index.md", "#measured"),
        ("https://a.example/b.md", "README.md", "index.md", "https://a.example/b.md"),
        ("../scripts/test", "docs/player.md", "player.md", "https://host.example/r/scripts/test"),
        ("../no/such/file", "docs/player.md", "player.md", "../no/such/file"),
    ],
)
def test_a_link_leads_where_it_led(hooks: dict[str, Any], target: str, source: str, page: str, wanted: str) -> None:
    assert hooks["turned_link"](target, source, page, "https://host.example/r/") == wanted


def test_a_link_to_a_file_without_a_page_is_text_where_no_host_is_known(hooks: dict[str, Any]) -> None:
    text = "See [`test`](scripts/test), [method](docs/method.md) and ![clip](docs/images/clip.jpg)."
    turned = hooks["turned"](text, "README.md", "index.md")
    assert turned == "See `test`, [method](method.md) and ![clip](images/clip.jpg)."


@pytest.mark.parametrize("code", ["`[a](docs/b.md)`", "```\n[a](docs/method.md)\n```"])
def test_code_stays_as_it_is(hooks: dict[str, Any], code: str) -> None:
    text = f"[a](docs/method.md)\n\n{code}\n\n[b](docs/method.md)"
    assert hooks["turned"](text, "README.md", "index.md") == f"[a](method.md)\n\n{code}\n\n[b](method.md)"
