# SPDX-License-Identifier: Apache-2.0
"""The player's module, HTML pages with a player and perhaps a stream, and the page that lists streams.

``player.js`` is one JavaScript module that ``scripts/build-player`` builds from ``viewer/packages``. It is part of the
repository and the wheel, so that installing the package does not need Node; a test rebuilds and compares it.

Note [Own origin only]
~~~~~~~~~~~~~~~~~~~~~~
The Content-Security-Policy of a page allows loading only from its own origin, and that of the single page no loading at
all. So neither the content of a stream nor the parameters of a link can make a browser contact a third party. Workers
are blobs of the module itself; styles are inline, because they are in the element's shadow root.
"""

import base64
import hashlib
import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from structgstream.atomic_files import atomic_write, side_path
from structgstream.codec.container.byte_source import ByteSource, FileBytes
from structgstream.codec.container.records import (
    PREFIX,
    RecordType,
    check_prefix,
    footer_offset,
    incomplete_reason,
    read_head,
)
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.stored_bytes import StoredBytes, is_segments, open_segments
from structgstream.errors import PlayerError, StorageError, StreamError

MAX_PAGE_STREAM_BYTES: Final = 256 * 10**6
"""Largest stream in a page, which holds it as base64, a third longer: browsers limit the length of a string, Chrome to
2^29 - 24 characters."""

_POLICY: Final = {
    "default-src": "'none'",
    "worker-src": "blob:",
    "img-src": "'self' blob: data:",
    "style-src": "'unsafe-inline'",
    "base-uri": "'none'",
    "form-action": "'none'",
}
_PLAYER_STYLE: Final = """<style>
html,body{margin:0;height:100%;color-scheme:light dark}
structgstream-player{width:100%;height:100%}
</style>
"""
_NOT_LOADED_STYLE: Final = """<style>
structgstream-player:not(:defined)::before{content:"The player is not loaded yet. If this stays: from a disk this page \
cannot load it; put its folder on a web server, or make a single page with structgstream export -o page.html.";\
display:block;padding:2rem;font:16px/1.5 system-ui,sans-serif;animation:late 3s}
@keyframes late{0%,99%{visibility:hidden}}
</style>
"""
_LIST_STYLE: Final = """<style>
:root{color-scheme:light dark;font:16px/1.5 system-ui,sans-serif}
body{margin:0 auto;max-width:72rem;padding:1.5rem}
h1{font-size:1.25rem;font-weight:600;margin:0 0 1rem}
ul{list-style:none;margin:0;padding:0;display:grid;gap:1rem;grid-template-columns:repeat(auto-fill,minmax(15rem,1fr))}
a{display:block;color:inherit;text-decoration:none;border:1px solid #8884;border-radius:.5rem;overflow:hidden}
a:hover,a:focus-visible{border-color:currentColor}
i{display:block;aspect-ratio:4/3;background:#8882 center/cover}
p{margin:0;padding:.5rem .75rem;display:flex;justify-content:space-between;gap:1rem;overflow-wrap:anywhere}
.live{color:#d22;font-weight:600}
</style>
"""
REFRESH_SECONDS: Final = 60
"""Interval at which the list is reloaded, because streams begin and end."""
_NO_SCRIPT: Final = "<noscript>This page plays a free-viewpoint video and needs JavaScript.</noscript>"


def bundle() -> str:
    """The module's source. Raises PlayerError if the installation lacks it."""
    path = files("structgstream.serve") / "assets" / "player.js"
    if not path.is_file():
        raise PlayerError(
            "The player is missing from the installation; reinstall structgstream, or, in a clone, run "
            "scripts/build-player."
        )
    return path.read_text(encoding="utf-8")


def policy(**sources: str) -> str:
    """A Content-Security-Policy (Note [Own origin only]); further directives have ``_`` for ``-``, as
    ``connect_src="'self'"``."""
    directives = _POLICY | {name.replace("_", "-"): value for name, value in sources.items()}
    return "; ".join(f"{name} {value}" for name, value in directives.items())


SERVED_POLICY: Final = {"script_src": "'self' blob:", "connect_src": "'self' blob:"}
"""Further directives of pages that load the module and the stream from their origin."""


def linked_page(
    title: str, *, stream: str, module: str = "player.js", attributes: Mapping[str, str] | None = None
) -> str:
    """A page that loads the player and the stream, both by addresses relative to the page, for a server; the element
    gets further ``attributes``."""
    script = f'{_NOT_LOADED_STYLE}<script type="module" src="{html.escape(module)}"></script>'
    body = f"{_element({'src': stream, **(attributes or {})})}\n{_NO_SCRIPT}"
    return _html(title, head=_PLAYER_STYLE + script, body=body, rules=policy(**SERVED_POLICY))


def single_page(title: str, *, module: str, stream: ByteSource) -> bytes:
    """A page that contains player and stream, and can be opened from a disk without a server. Raises PlayerError if the
    stream is too long for a page."""
    if len(stream) > MAX_PAGE_STREAM_BYTES:
        raise PlayerError(
            f"The stream has {len(stream) / 1e6:.0f} MB, and a page can contain up to "
            f"{MAX_PAGE_STREAM_BYTES / 1e6:.0f}; watch it with structgstream play, or put the folder that "
            "--format site writes on a web server."
        )
    inlined = inline_module(module)
    digest = base64.b64encode(hashlib.sha256(inlined.encode()).digest()).decode()
    rules = policy(script_src=f"'sha256-{digest}' blob:", connect_src="blob: data:")
    data = '<script type="application/octet-stream;base64" id="stream">'
    element = f'{_element({"src": "#stream"})}<script type="module">{inlined}</script>\n{_NO_SCRIPT}'
    page = _html(title, head=f"{_PLAYER_STYLE}{data}</script>", body=element, rules=rules)
    before, after = page.split(data)
    return b"".join((before.encode(), data.encode(), base64.b64encode(stream[:]), after.encode()))


def inline_module(source: str) -> str:
    """A module escaped for a ``script`` element, which ends at the first ``</script`` in any context.

    In JavaScript these letters occur only in strings and regular expressions, where a backslash before the slash has no
    effect.
    """
    # After <!-- a parser treats <script> and </script> as a nested pair. Our bundle does not contain it.
    assert "<!--" not in source, "an HTML comment cannot be inlined"
    return re.sub(r"</(?=script)", r"<\\/", source, flags=re.IGNORECASE)


def _element(attributes: Mapping[str, str]) -> str:
    written = "".join(f' {name}="{html.escape(value)}"' for name, value in attributes.items())
    return f"<structgstream-player{written} autoplay loop></structgstream-player>"


def _html(title: str, *, head: str, body: str, rules: str) -> str:
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{html.escape(rules, quote=False)}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{html.escape(title)}</title>
{head}
</head>
<body>
{body}
</body>
</html>
"""


def list_page(streams: Sequence[Mapping[str, Any]], *, query: str) -> str:
    """The page of all streams."""
    entries = "\n".join(_entry(stream, query) for stream in streams)
    body = f"<h1>Streams</h1>\n<ul>\n{entries}\n</ul>" if streams else "<h1>Streams</h1>\n<p>There is none yet.</p>"
    refresh = f'<meta http-equiv="refresh" content="{REFRESH_SECONDS}">\n'
    return _html("Streams", head=refresh + _LIST_STYLE, body=body, rules=policy())


def _entry(stream: Mapping[str, Any], query: str) -> str:
    page, preview = (html.escape(f"{stream[name]}{query}") for name in ("page", "preview"))
    state = '<span class="live">live</span>' if stream["live"] else _duration(stream["seconds"])
    # A background, because a missing picture would be shown as broken.
    picture = f'<i style="background-image:url(&quot;{preview}&quot;)"></i>'
    return f'<li><a href="{page}">{picture}<p><span>{html.escape(stream["name"])}</span>{state}</p></a></li>'


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return ""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"<span>{hours}:{minutes:02}:{rest:02}</span>" if hours else f"<span>{minutes}:{rest:02}</span>"


PIECE_BYTES = 2**20


@dataclass(frozen=True)
class StreamFile:
    """The file or folder at ``path``; every method opens it anew, because it may be replaced at any time."""

    path: Path

    @property
    def title(self) -> str:
        """Its name for a page."""
        return side_path(self.path, "").name

    def opened(self) -> FileBytes | StoredBytes:
        """The open stream at its present length. Raises StreamError if it cannot be read, or its first frames have been
        removed from the window."""
        if not is_segments(self.path):
            return FileBytes(self.path)
        stored = open_segments(self.path)
        if stored.gone:
            raise StreamError(
                f"{self.path} stores a window of frames, and the first frames have been removed; it cannot be shown as "
                "one file. Show it with structgstream serve."
            )
        return stored

    def state(self) -> dict[str, int | bool]:
        """The ``bytes`` of the file, and whether it is ``complete``. Raises StreamError if it cannot be read."""
        with self.opened() as data:
            return file_state(data)

    def check(self) -> None:
        """Check that the file has a whole header, see :func:`check_has_header`."""
        with self.opened() as data:
            check_has_header(data, str(self.path))

    def has_header(self) -> bool:
        """Whether the file exists and has a whole header. Raises StreamError if it is no stream of this version."""
        manifest = self.path if self.path.name == MANIFEST else self.path / MANIFEST
        if not (manifest if is_segments(self.path) else self.path).exists():
            return False
        with self.opened() as data:
            if len(data) < PREFIX.size:
                return False
            check_prefix(data, str(self.path))
            return read_head(data, PREFIX.size) is not None


def file_state(data: ByteSource) -> dict[str, int | bool]:
    """The ``bytes`` of a stream's file, and whether it is ``complete``, that is, has its index."""
    return {"bytes": len(data), "complete": footer_offset(data) is not None}


def check_has_header(data: ByteSource, name: str) -> None:
    """Check that a stream has a whole header. Raises StreamError if it is empty, no stream, of another version, or
    truncated within its header."""
    if not len(data):
        raise StreamError(f"{name} is empty; expected a stream made by structgstream reconstruct.")
    check_prefix(data, name)
    head = read_head(data, PREFIX.size)
    if head is None or head.type != RecordType.INIT:
        raise StreamError(f"No frame of {name} can be decoded: {incomplete_reason(data, PREFIX.size)}.")


def write_page(path: Path, stream: StreamFile) -> int:
    """Writes one HTML page that contains the player and the stream at its present length; returns its bytes.

    Raises:
        PlayerError: the stream is too long for a page, or the installation lacks the player.
        StreamError: no frame of the stream can be decoded.
        StorageError: the page cannot be written.
    """
    with stream.opened() as data:
        check_has_header(data, str(stream.path))
        page = single_page(stream.title, module=bundle(), stream=data)
    atomic_write(path, page, new_folder=True)
    return len(page)


def write_site(folder: Path, stream: StreamFile) -> int:
    """Writes ``index.html``, ``player.js`` and ``stream.sgs`` into a folder; a web server needs nothing else. Returns
    the bytes of the three files.

    Raises:
        PlayerError: the installation lacks the player.
        StreamError: no frame of the stream can be decoded.
        StorageError: a file cannot be written, or would replace the stream itself or a page without a player.
    """
    stream.check()
    copy = folder / "stream.sgs"
    if copy.exists() and copy.samefile(stream.path):
        raise StorageError(f"{copy} is the stream itself; name another folder.")
    page = folder / "index.html"
    if page.exists() and b"<structgstream-player" not in page.read_bytes():
        raise StorageError(f"{page} is another page, which the site would replace; name another folder.")
    small = {"index.html": linked_page(stream.title, stream="stream.sgs").encode(), "player.js": bundle().encode()}
    for name, content in small.items():
        atomic_write(folder / name, content, new_folder=True)
    with stream.opened() as data:
        pieces = (data[start : start + PIECE_BYTES] for start in range(0, len(data), PIECE_BYTES))
        atomic_write(copy, pieces, new_folder=True)
        return sum(map(len, small.values())) + len(data)
