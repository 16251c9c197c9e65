# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, and how they are parsed."""

import ast
import inspect
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError, usage_errors
from structgstream.exporters.formats import SUFFIXES

if TYPE_CHECKING:
    from structgstream.codec.segments.sink import Clocks, SegmentsOptions
    from structgstream.data.source import FrameSource
    from structgstream.recorder import Storage
    from structgstream.scene.scene import Scene
    from structgstream.session.presets import StreamConfig


def shown_as(metavar: str | None = None, *aliases: str) -> Any:
    """How help shows an option whose text states its default."""
    return tyro.conf.arg(metavar=metavar, aliases=aliases, help_behavior_hint="")


Options = TypeVar("Options")
Device = Literal["auto", "cpu", "cuda", "reference"]
Folder = Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
StreamFile = Annotated[Path, tyro.conf.arg(metavar="STREAM")]
StreamOutput = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
Cameras = Annotated[tuple[str, ...] | None, shown_as("CAMERA [CAMERA ...]")]
Number = Annotated[int | None, shown_as("N")]
PresetName = Annotated[str | None, shown_as("NAME")]
Flag = Annotated[bool, shown_as()]
JsonPath = Annotated[Path | None, shown_as("PATH|-")]
STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)


@dataclass(frozen=True)
class CaptureOptions:
    """Options that select the part of a capture, and its picture size."""

    held_out: Cameras = None
    """Cameras to keep from training; auto: the one best surrounded by others. Default: those that the capture's
    layout holds out."""
    scale: float = 1.0
    """Size of the pictures relative to the stored ones, in (0, 1]."""
    start: int = 0
    """First frame to use."""
    frames: Number = None
    """Number of frames. Default: all."""
    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Use every N-th frame, from the first; the frames a second are divided by N."""
    near: Annotated[float | None, shown_as()] = None
    """Distance of the near plane, in units of the capture. Default: the capture's own, else 0.12 times the
    largest distance of a training camera to their centre."""
    roving: Literal["auto", "none"] = "auto"
    """Whether frame 0 is trained on the pictures of a roving camera, too, where prepare registered some."""


PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".gif")
VIDEOS = (".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi", ".mpg", ".ts")
EXPORTS = tuple(f".{name}" for name in SUFFIXES)
KNOWN_ENDINGS = frozenset({*PICTURES, *VIDEOS, *EXPORTS, ".html", ".json", ".pdf", ".sgs", ".zip"})
"""Endings of pictures, videos, exports and streams, of which a command writes some."""
STANDARD_OUTPUT = "-"
"""As the value of ``--json``."""


def check_ending(output: Path | None, *endings: str, command: str, option: str = "-o", folder: bool = False) -> None:
    """Check that a name has none of :data:`KNOWN_ENDINGS` except those that the command writes; another may name a
    ``folder``."""
    if output is not None and (ending := output.suffix.lower()) in KNOWN_ENDINGS.difference(endings):
        written = " or ".join([*endings, *(["a folder of another name"] if folder else [])])
        advice = f"it writes {written}" if written else "choose a name without this ending"
        raise UsageError(f"{command} writes no {ending}, got {option} {output}; {advice}.")


def check_new(output: Path, *, overwrite: bool) -> None:
    """Check that a file does not exist, or may be replaced."""
    if output.exists() and not overwrite:
        raise UsageError(f"{output} exists; replace it with --overwrite, or choose another name.")


def checked_paths(options: Options) -> Options:
    """Options, also those in groups, with ``~`` in paths expanded as a shell does it, and ``.`` and ``..`` at their end
    resolved, because names of files beside a folder are made from its name."""
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
        path = value.expanduser()
    except RuntimeError:
        raise UsageError(f"there is no user for {value}; give the path in full.") from None
    return path.resolve() if path.name in ("", "..") else path


def write_json_output(path: Path | None, content: Mapping[str, Any]) -> Console:
    """Writes ``--json``: nothing for None, to standard output for ``-``.

    Returns:
        The console for everything else that is printed: standard error where JSON goes to standard output.
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
    """The options of a command; prints and exits on ``--help`` or wrong usage."""
    return checked_paths(tyro.cli(kind, prog=f"structgstream {command}", args=arguments, config=STYLE))


def parse_known_options(kind: type[Options], command: str, *, arguments: list[str]) -> tuple[Options, list[str]]:
    """As :func:`parse_options`, and the arguments that are no options of the command itself."""
    options, rest = tyro.cli(
        kind, prog=f"structgstream {command}", args=arguments, config=STYLE, return_unknown_args=True
    )
    return checked_paths(options), rest


def as_arguments(options: Any, *names: str) -> list[str]:
    """The command line of those fields of a dataclass of options that differ from their defaults."""
    words: list[str] = []
    for field in fields(options):
        value = getattr(options, field.name)
        if field.name in names and value != field.default:
            words.append(f"--{field.name.replace('_', '-')}")
            words += [] if value is True else map(str, value) if isinstance(value, tuple) else [str(value)]
    return words


def resolve_config(
    preset: str | None, overrides: list[str], *, command: str, seed: int | None
) -> tuple["StreamConfig", str]:
    """The preset with the fields set on the command line by their path (``--online.iterations 50``), and its name."""
    from structgstream.session.presets import DEFAULT_PRESET, StreamConfig, preset_named

    name = DEFAULT_PRESET if preset is None else preset
    with usage_errors():
        config = tyro.cli(
            StreamConfig,
            prog=f"structgstream {command}",
            description=f"Fields of the configuration, with the values of the preset {name!r} as defaults.",
            default=preset_named(name),
            args=overrides,
            config=(tyro.conf.FlagConversionOff,),
        )
        return (config if seed is None else replace(config, seed=seed)), name


def open_selected_capture(scene: Path, options: CaptureOptions) -> "FrameSource":
    """The part of a capture that the options select."""
    from structgstream.data.open import open_capture

    return open_capture(scene, **{**vars(options), "roving": options.roving == "auto"})


COLUMN = 52
"""Where sentences begin; after longer values, two blanks behind them."""


def config_lines(config: Any, *, width: int | None = None) -> list[str]:
    """A line for each field of a configuration: its option, its value, and its first sentence; cut after ``width``
    columns."""
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
    return found


FINISH_SECONDS = 60.0
"""How long the end of a run waits for what is still to be published."""
Sink = Literal["file", "segments"]


@dataclass(frozen=True)
class SegmentOptions:
    """Options of --sink segments (docs/segments.md)."""

    sink: Annotated[Sink | None, shown_as()] = None
    """file: OUT is one file. segments: OUT is a folder of immutable files and a manifest, which any web host can serve
    while it grows. Default: segments if OUT is a folder with a manifest.json, else file."""
    window: Annotated[float | None, shown_as("SECONDS")] = None
    """Segments only: how far viewers can go back; older segments are removed. Default: nothing is removed."""
    keep: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 120.0
    """Segments only: how long a file stays that the manifest no longer names; viewers may be about to fetch it."""
    publish: Annotated[str | None, shown_as("URL")] = None
    """Segments only: copy OUT to this folder of an object store as it grows, such as s3://bucket/studio. When it cannot
    be reached, the stream continues in OUT, and is copied later. Needs the extra cloud."""

    def chosen(self, output: Path) -> Sink:
        """The sink of ``output``."""
        from structgstream.codec.segments.manifest import MANIFEST
        from structgstream.codec.segments.quality_list import read_list

        if read_list(output) is not None:
            raise UsageError(
                f"{output} holds several qualities of one stream; continue them with --qualities, or choose another "
                "name."
            )
        sink: Sink = self.sink or ("segments" if (output / MANIFEST).is_file() else "file")
        if sink == "file" and (self.window is not None or self.publish is not None):
            raise UsageError(f"{'--publish' if self.window is None else '--window'} is for --sink segments.")
        self._checked()
        return sink

    def _checked(self) -> "SegmentsOptions":
        from structgstream.codec.segments.sink import SegmentsOptions

        if not (self.window is None or 0 < self.window < math.inf) or not self.keep >= 0:
            raise UsageError("--window must be a positive number of seconds, and --keep zero or more.")
        return SegmentsOptions(self.window, self.keep)

    def quality_folders(
        self, output: Path, names: Sequence[str], *, resume: bool, overwrite: bool, clocks: "Clocks | None" = None
    ) -> "dict[str, Storage[Scene]]":
        """Where each quality of a stream goes, a folder in ``output``, checked before anything takes time."""
        from structgstream.codec.segments.manifest import MANIFEST
        from structgstream.codec.segments.quality_list import read_list
        from structgstream.recorder import segments_at, segments_folder

        listed = read_list(output)
        if self.sink == "file" or (self.sink is None and listed is None):
            got = "no --sink" if self.sink is None else "--sink file"
            raise UsageError(
                f"--qualities writes a folder of segments for each quality, got {got}; add --sink segments."
            )
        if self.publish is not None:
            raise UsageError(
                "--publish copies one stream, and --qualities writes several; copy the folder with another program, or "
                "run without it."
            )
        options = self._checked()
        if (output / MANIFEST).is_file():
            raise UsageError(f"{output} holds one stream, and --qualities writes several; choose another name.")
        there = [quality.name for quality in listed or ()]
        if listed is not None and (resume or overwrite) and sorted(there) != sorted(names):
            raise UsageError(
                f"{output} holds the qualities {', '.join(there)}, got {', '.join(names)}; give the same names, or "
                "choose another OUT."
            )
        stores = {name: segments_folder(output / name, may_exist=resume or overwrite) for name in names}
        return {name: segments_at(store, options=options, clocks=clocks) for name, store in stores.items()}

    @contextmanager
    def storage(
        self, output: Path, *, may_exist: bool, report: Callable[[str], object], clocks: "Clocks | None" = None
    ) -> Iterator["Storage[Scene] | None"]:
        """Where the stream goes, checked before anything takes time; None for the file ``output``.

        The end of the block waits up to :data:`FINISH_SECONDS` until everything is published; ``report`` gets a
        sentence if files remain.
        """
        from structgstream.recorder import check_output, segments_at, segments_folder

        options = self._checked()
        if self.chosen(output) == "file":
            check_output(output, may_exist=may_exist)
            yield None
        elif self.publish is None:
            yield segments_at(segments_folder(output, may_exist=may_exist), options=options, clocks=clocks)
        else:
            from structgstream.codec.segments.mirror import AnotherStreamError, MirroredStore, MirrorOptions
            from structgstream.codec.segments.store import CloudStore
            from structgstream.errors import StorageError, StreamError

            remote = CloudStore(self.publish)
            folder = segments_folder(output, may_exist=may_exist)
            mirror = MirroredStore(folder, remote, options=MirrorOptions(self.keep, report))
            try:
                mirror.claim()
            except AnotherStreamError:
                raise
            except (StorageError, StreamError):
                pass  # It cannot be reached now; it is claimed as soon as it can be.
            mirror.copy_all()  # What an earlier run has left, also if there is nothing to do now.
            try:
                yield segments_at(mirror, options=options, clocks=clocks)
            finally:
                if left := mirror.finish(wait_seconds=FINISH_SECONDS):
                    report(
                        f"{left} files of {output} are not yet in {remote.name}; the next run with --resume, or any "
                        "program that copies folders, copies them."
                    )
