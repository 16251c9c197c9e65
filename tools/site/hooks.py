# SPDX-License-Identifier: Apache-2.0
"""What MkDocs needs to make a site of this repository's documents as they are (mkdocs.yml).

Note [One text, two readers]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~
Documents are written for a code host: links are relative to the file, and may leave ``docs/``. On the site README,
ARCHITECTURE, CONTRIBUTING and CHANGELOG are pages too, so links to them and from them are turned. A link to any other
file of the repository leads to the code host when ``SOURCE_URL`` says where its files are, and is plain text otherwise.
"""

import ast
import os
import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
DOCUMENTS = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""Documents outside ``docs/`` and their names on the site."""
API = "api.md"
API_HEAD = """# API reference

What `import structgstream` gives; names are resolved on first use. Axes, units and letters of shapes:
[conventions](conventions.md).
"""
GROUPS = {
    "Functions": str.islower,
    "Classes": lambda name: not name.islower() and not name.isupper(),
    "Constants": str.isupper,
}

STYLE = "css/site.css"

_CODE = re.compile(r"^(```|~~~).*?^\1[^\n]*$|`+[^`\n]+`+", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(?P<image>!?)\[(?P<text>(?:!\[[^\]]*\]\([^)]*\)|[^\[\]])*)\]\((?P<target>[^)\s]+)\)")


def public_names(source: str) -> list[str]:
    """``__all__`` of a module, read without importing it."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign) and [getattr(target, "id", None) for target in node.targets] == ["__all__"]:
            return list(ast.literal_eval(node.value))
    raise ValueError("The module has no __all__ that is written as a list of names.")


def api_page(names: list[str]) -> str:
    """The page of the API reference: a directive of mkdocstrings for each name, by kind."""
    parts = [API_HEAD]
    for title, belongs in GROUPS.items():
        directives = [f"::: structgstream.{name}\n" for name in names if belongs(name.replace("_", ""))]
        parts += [f"## {title}\n", *directives] if directives else []
    return "\n".join(parts)


def turned_link(target: str, source: str, page: str, source_url: str) -> str | None:
    """Where a link leads on the site; None when nothing there answers it.

    Args:
        target: as the document has it.
        source: the document's path in the repository.
        page: its path on the site.
        source_url: folder of the repository's files on the web, or nothing.
    """
    if re.match(r"[a-z]+:|#", target):
        return target
    path, mark, anchor = target.partition("#")
    place = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
    inside = DOCUMENTS.get(place) or (place.removeprefix("docs/") if place.startswith("docs/") else None)
    if inside is not None:
        return posixpath.relpath(inside, posixpath.dirname(page) or ".") + mark + anchor
    if not (ROOT / place).exists():
        return target  # MkDocs says that there is no such file.
    return f"{source_url.rstrip('/')}/{place}{mark}{anchor}" if source_url else None


def turned(markdown: str, source: str, page: str, source_url: str = "") -> str:
    """A document with its links turned (Note [One text, two readers]); code stays as it is."""

    def link(match: re.Match[str]) -> str:
        text = match["text"] if match["image"] else _LINK.sub(link, match["text"])
        target = turned_link(match["target"], source, page, source_url)
        return text if target is None else f"{match['image']}[{text}]({target})"

    parts, place = [], 0
    for code in _CODE.finditer(markdown):
        # Code inside a link's text belongs to the link.
        if markdown.rfind("[", place, code.start()) > markdown.rfind("]", place, code.start()):
            continue
        parts += [_LINK.sub(link, markdown[place : code.start()]), code[0]]
        place = code.end()
    return "".join([*parts, _LINK.sub(link, markdown[place:])])


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Adds the documents that lie outside ``docs/``, the API reference and a style sheet."""
    from mkdocs.structure.files import File

    for name, page in DOCUMENTS.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text()))
    names = public_names((ROOT / "src" / "structgstream" / "__init__.py").read_text())
    files.append(File.generated(config, API, content=api_page(names)))
    files.append(File.generated(config, STYLE, abs_src_path=str(Path(__file__).with_name("site.css"))))
    return files


def on_page_markdown(markdown: str, *, page: "Page", config: "MkDocsConfig", files: "Files") -> str:
    """Turns the links of a page."""
    path = page.file.src_uri
    if path == API:
        return markdown
    source = {page: name for name, page in DOCUMENTS.items()}.get(path, f"docs/{path}")
    return turned(markdown, source, path, os.environ.get("SOURCE_URL", ""))


def on_page_content(html: str, *, page: "Page", config: "MkDocsConfig", files: "Files") -> str:
    """Drops the roles before names in docstrings (``:class:``), which Markdown does not know."""
    return re.sub(r":(?:attr|class|func|meth|mod):(?=<code>)", "", html) if page.file.src_uri == API else html
