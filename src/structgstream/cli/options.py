# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, and how they are parsed."""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError, usage_errors
from structgstream.exporters.formats import SUFFIXES

if TYPE_CHECKING:
    from structgstream.data.source import FrameSource
    from structgstream.session.presets import StreamConfig

Options = TypeVar("Options")
Device = Literal["auto", "cpu", "cuda", "reference"]
Folder = Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
StreamFile = Annotated[Path, tyro.conf.arg(metavar="STREAM")]
Flag = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
JsonPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH|-", help_behavior_hint="")]
STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)


@dataclass(frozen=True)
class CaptureOptions:
    """Options that select the part of a capture, and its picture size."""

    held_out: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="CAMERA [CAMERA ...]", help_behavior_hint="")] = (
        None
    )
    """Cameras to keep from training; auto: the one best surrounded by others. Default: those that the capture's
    layout holds out."""
    scale: float = 1.0
    """Size of the pictures relative to the stored ones, in (0, 1]."""
    start: int = 0
    """First frame to use."""
    frames: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Number of frames. Default: all."""
    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Use every N-th frame, from the first; the frames a second are divided by N."""
    near: Annotated[float | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Distance of the near plane, in units of the capture. Default: the capture's own, else 0.12 times the
    largest distance of a training camera to their centre."""


PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".gif")
VIDEOS = (".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi", ".mpg", ".ts")
EXPORTS = tuple(f".{name}" for name in SUFFIXES)
KNOWN_ENDINGS = frozenset({*PICTURES, *VIDEOS, *EXPORTS, ".html", ".json", ".pdf", ".sgs", ".zip"})
"""Endings of pictures, videos, exports and streams, of which a command writes some."""
RENAMED = {"--quiet": "--split-at-low-motion", "--odd": "--allow-unaligned"}
"""Options of before, and what they are called now."""
STANDARD_OUTPUT = "-"
"""As the value of ``--json``."""


def check_ending(output: Path | None, *endings: str, command: str, option: str = "-o", folder: bool = False) -> None:
    """Check that a name does not ask for a kind of file that the command does not write.

    Args:
        output: the file or folder to write; None for none.
        endings: of :data:`KNOWN_ENDINGS`, those that the command writes.
        folder: whether another name gives a folder.

    Raises:
        UsageError: it does.
    """
    if output is not None and (ending := output.suffix.lower()) in KNOWN_ENDINGS.difference(endings):
        written = " or ".join([*endings, *(["a folder of another name"] if folder else [])])
        raise UsageError(f"{command} writes no {ending}, got {option} {output}; it writes {written}.")


def check_new(output: Path, *, overwrite: bool) -> None:
    """Check that a file does not exist, or may be replaced.

    Raises:
        UsageError: it exists.
    """
    if output.exists() and not overwrite:
        raise UsageError(f"{output} exists; replace it with --overwrite, or choose another name.")


def checked_paths(options: Options) -> Options:
    """Options, also those in groups, with ``~`` in paths expanded as a shell does it.

    Raises:
        UsageError: a path is ``-``, which is standard output for ``--json`` only, or ``~`` of a user there is not.
    """
    return replace(options, **{one.name: _checked(getattr(options, one.name), one.name) for one in fields(options)})  # type: ignore[type-var]


def _checked(value: object, name: str) -> object:
    if isinstance(value, tuple):
        return tuple(_checked(one, name) for one in value)
    if is_dataclass(value) and not isinstance(value, type):
        return checked_paths(value)
    if not isinstance(value, Path) or (str(value) == STANDARD_OUTPUT and name == "json"):
        return value
    if str(value) == STANDARD_OUTPUT:
        raise UsageError(f"{name} '-' would be a file or folder of that very name; give a path.")
    try:
        return value.expanduser()
    except RuntimeError:
        raise UsageError(f"there is no user for {value}; give the path in full.") from None


def write_json_output(path: Path | None, content: Mapping[str, Any]) -> Console:
    """Writes ``--json``: nothing for None, to standard output for ``-``.

    Returns:
        The console for everything else that is printed: standard error where JSON goes to standard output.

    Raises:
        StorageError: the file cannot be written.
    """
    from structgstream.evaluation.report import json_text, write_json

    if path is None:
        return Console()
    if str(path) == STANDARD_OUTPUT:
        print(json_text(content), end="", flush=True)
        return Console(stderr=True)
    write_json(path, content)
    return Console()


def parse_options(kind: type[Options], command: str, *, arguments: list[str]) -> Options:
    """The options of a command; prints and exits on ``--help`` or wrong usage.

    Raises:
        UsageError: an option was renamed, or a path cannot be meant (:func:`checked_paths`).
    """
    _check_renamed(arguments)
    return checked_paths(tyro.cli(kind, prog=f"structgstream {command}", args=arguments, config=STYLE))


def parse_known_options(kind: type[Options], command: str, *, arguments: list[str]) -> tuple[Options, list[str]]:
    """As :func:`parse_options`, and the arguments that are no options of the command itself."""
    _check_renamed(arguments)
    options, rest = tyro.cli(
        kind, prog=f"structgstream {command}", args=arguments, config=STYLE, return_unknown_args=True
    )
    return checked_paths(options), rest


def _check_renamed(arguments: list[str]) -> None:
    for argument in arguments:
        if (name := argument.partition("=")[0]) in RENAMED:
            raise UsageError(f"{name} is called {RENAMED[name]} now.")


def resolve_config(
    preset: str | None, overrides: list[str], *, command: str, seed: int | None
) -> tuple["StreamConfig", str]:
    """The preset with the fields set on the command line by their path (``--online.iterations 50``), and its name.

    Raises:
        UsageError: there is no such preset, the seed is negative, or a field has another name or is
            a constant now.
    """
    from structgstream.config_fields import constant_at
    from structgstream.session.presets import DEFAULT_PRESET, StreamConfig, preset_named, renamed

    for option in (override.partition("=")[0] for override in overrides if override.startswith("--")):
        path = option.removeprefix("--").replace("-", "_")
        now = renamed(path)
        if (value := constant_at(StreamConfig, now)) is not None:
            raise UsageError(f"{option} is no option any more: it is always {value}.")
        if now != path:
            raise UsageError(f"{option} is called --{now.replace('_', '-')} now.")
    name = DEFAULT_PRESET if preset is None else preset
    with usage_errors():
        default = preset_named(name)
    description = f"Fields of the configuration, with the values of the preset {name!r} as defaults."
    with usage_errors():
        config = tyro.cli(
            StreamConfig,
            prog=f"structgstream {command}",
            description=description,
            default=default,
            args=overrides,
            config=(tyro.conf.FlagConversionOff,),
        )
        return (config if seed is None else replace(config, seed=seed)), name


def open_selected_capture(scene: Path, options: CaptureOptions) -> "FrameSource":
    """The part of a capture that the options select."""
    from structgstream.data.open import open_capture

    return open_capture(
        scene,
        held_out=options.held_out,
        scale=options.scale,
        start=options.start,
        frames=options.frames,
        near=options.near,
        every=options.every,
    )


COLUMN = 52
"""Where sentences begin; after longer values, two blanks behind them."""


def config_lines(config: Any, *, width: int | None = None) -> list[str]:
    """A line for each field of a configuration: its option, its value, and its first sentence.

    Args:
        config: a dataclass of dataclasses.
        width: columns; longer lines are cut. None for no limit.
    """
    lines = [f"{option:<{COLUMN - 2}}  {sentence}" for option, sentence in _rows(config, "--")]
    return [line if width is None or len(line) <= width else f"{line[: width - 1]}…" for line in lines]


def _rows(config: Any, prefix: str) -> Iterator[tuple[str, str]]:
    """Option with value, and sentence, of each field; those of nested configurations after it."""
    sentences, nested = first_sentences(type(config)), []
    for field in fields(config):
        value, option = getattr(config, field.name), f"{prefix}{field.name.replace('_', '-')}"
        if is_dataclass(value):
            nested.append((value, f"{option}."))
        else:
            yield f"{option} {_shown(value)}", sentences.get(field.name, "")
    for value, option in nested:
        yield from _rows(value, option)


def _shown(value: Any) -> str:
    if isinstance(value, frozenset):
        return " ".join(sorted(value))
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def first_sentences(kind: type) -> dict[str, str]:
    """The first sentence of the docstring below each field of a class and of its bases."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(body, ast.ClassDef)
        for item, after in zip(body.body, body.body[1:], strict=False):
            match item, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    plain = re.sub(r":\w+:|`", "", " ".join(text.split()))
                    found[name] = re.split(r"(?<=\.) (?=[A-Z0-9])", plain)[0]
                case _:
                    pass
    return found
