# SPDX-License-Identifier: Apache-2.0
"""Every command line that a document or a help text shows is one that the program takes.

Those in blocks and in help are parsed whole, by the parser of the command, and not run. Those within sentences may
leave out what the sentence says, so there the options must exist. Programs of the repository have to be
there and to name the options that are shown.
"""

import contextlib
import importlib
import inspect
import io
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from structgstream.cli import app, options
from structgstream.cli.app import COMMANDS

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/*.md", "examples/**/*.md", "viewer/*.md", "deploy/*")
    for path in ROOT.glob(pattern)
    if path.is_file()
)
PROGRAM = re.compile(rf"(?:^|[\s`/=])structgstream ((?:{'|'.join(COMMANDS)})\b[^`]*)")
SCRIPT = re.compile(
    r"python (-m (?:benchmarks|tools|tests|lab)[\w.]*|(?:benchmarks|tools|tests|lab)/[\w/]+\.py)([^`]*)"
)
OPTION = re.compile(r"(?<![\w-])--[a-z][\w.-]*\w")


def home_of(command: str) -> ModuleType:
    """The module of a command."""
    return importlib.import_module(app.entry_of(command).__module__)


def blocks(text: str) -> Iterator[str]:
    """The lines of code blocks; one that ends in a backslash goes on."""
    inside = False
    for line in text.replace("\\\n", " ").splitlines():
        if line.strip().startswith("```"):
            inside = not inside
        elif inside or line.startswith("    "):
            yield line


def spans(text: str) -> Iterator[str]:
    """Code within sentences."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    for found in re.findall(r"`([^`]+)`", prose):
        yield " ".join(found.split())


def documented(read: Any, pattern: re.Pattern[str]) -> list[Any]:
    """Parameters: what ``pattern`` finds, and where."""
    found = {}
    for path in DOCUMENTS:
        for code in read(path.read_text()):
            for match in pattern.finditer(code):
                found.setdefault(
                    match[0].strip("` "), pytest.param(*match.groups(), id=f"{path.name}: {match[0]}"[:90])
                )
    return list(found.values())


def examples() -> list[Any]:
    """The examples in the help of commands, and in that of the program."""
    texts = [("overview", app.overview())]
    texts += [(name, inspect.getsource(home_of(name))) for name in COMMANDS]
    pattern = re.compile(r"^\s*(?:Example: )?structgstream (\w.*)$", re.MULTILINE)
    found = [(name, line) for name, text in texts for line in pattern.findall(text)]
    assert {name for name, _ in found} == {"overview", *COMMANDS}
    return [pytest.param(line, id=line[:90]) for line in dict.fromkeys(line for _, line in found)]


def words_of(line: str) -> list[str]:
    """The arguments of a shown command, without remarks and what a shell takes."""
    words = shlex.split(re.split(r"\s{3,}\(", line)[0], comments=True)
    ends = [index for index, word in enumerate(words) if word in ("&", "|", "||", "&&", ";", ">")]
    return words[: min(ends, default=len(words))]


class Parsed(Exception):
    """The command line was taken."""


def parsed(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Parse a command line as its command does, and stop there.

    Raises:
        Parsed: it was taken.
    """
    command, *arguments = words
    module = home_of(command)

    def known(kind: type[Any], name: str, *, arguments: list[str]) -> None:
        found, rest = options.parse_known_options(kind, name, arguments=arguments)
        if rest or found.preset is not None:
            options.resolve_config(found.preset, rest, command=name, seed=None)
        raise Parsed

    def whole(kind: type[Any], name: str, *, arguments: list[str]) -> None:
        options.parse_options(kind, name, arguments=arguments)
        raise Parsed

    for name, replaced in (("parse_known_options", known), ("parse_options", whole)):
        if hasattr(module, name):
            monkeypatch.setattr(module, name, replaced)
    app.entry_of(command)(arguments)


@cache
def options_of(command: str) -> frozenset[str]:
    """The options in a command's help, and the fields of a configuration where it takes them."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        app.main([command, "--help"])
        if command in ("reconstruct", "demo"):
            app.main(["reconstruct", "--help-config"])
    return frozenset(OPTION.findall(out.getvalue()))


BLOCKS, SPANS = documented(blocks, PROGRAM), documented(spans, PROGRAM)
SCRIPTS = documented(lambda text: [*blocks(text), *spans(text)], SCRIPT)


def test_there_is_something_to_look_at() -> None:
    assert len(BLOCKS) > 50
    assert len(SPANS) > 10
    assert SCRIPTS


@pytest.mark.parametrize("line", [*BLOCKS, *examples()])
def test_a_command_that_is_shown_can_be_given(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = words_of(line)
    if words == [words[0]] or set(words) & {"...", "COMMAND"}:
        assert words[0] in {*COMMANDS, "COMMAND"}
        return
    with pytest.raises(Parsed):
        parsed(words, monkeypatch)


@pytest.mark.parametrize("line", SPANS)
def test_a_command_in_a_sentence_has_its_options(line: str) -> None:
    command = line.split()[0]
    assert set(OPTION.findall(line)) <= options_of(command) | {"--debug", "--help"}


@pytest.mark.parametrize(("program", "line"), SCRIPTS)
def test_a_program_that_is_shown_is_there_with_its_options(program: str, line: str) -> None:
    name = program.removeprefix("-m ")
    path = ROOT / (name if name.endswith(".py") else name.replace(".", "/"))
    source = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
    assert source.is_file()
    text = source.read_text()
    shown = set(OPTION.findall(re.split(r"\s#|\s&&?\s", line)[0]))
    if "BooleanOptionalAction" in text:
        shown = {option.replace("--no-", "--") for option in shown}
    assert not {option for option in shown if f'"{option}"' not in text}


def test_a_wrong_command_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    for line in (
        "play ball.sgs --wiat",
        "reconstruct a -o b.sgs --online.iteration 5",
        "render ball.sgs --path spiral",
    ):
        with pytest.raises(SystemExit):
            parsed(words_of(line), monkeypatch)
    assert words_of("reconstruct a -o 'b c.sgs' &   # and | more") == ["reconstruct", "a", "-o", "b c.sgs"]
    assert words_of("token a --address https://x/     (prints the link)") == ["token", "a", "--address", "https://x/"]
