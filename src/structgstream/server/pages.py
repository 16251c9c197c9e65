# SPDX-License-Identifier: Apache-2.0
"""The list of streams, as a page and as values."""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from structgstream.player.page import html_page, policy
from structgstream.server.catalog import StreamKind

_STYLE = """<style>
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
REFRESH_SECONDS = 60
"""After which the list is loaded again: streams come and end, and previews that were not ready are asked for."""

LIST_POLICY = policy(frame_ancestors="'self'")


@dataclass(frozen=True)
class Listed:
    """A stream in the list.

    Args:
        name: of the stream.
        kind: ``segments``, ``qualities`` or ``file``.
        live: whether it is being made; None where that is not known.
        seconds: of media up to its end; None where that is not known.
    """

    name: str
    kind: str
    live: bool | None
    seconds: float | None

    def as_json(self) -> dict[str, Any]:
        """Its entry in ``streams.json``; addresses are relative to that."""
        base = f"streams/{self.name}/"
        source = StreamKind(self.kind).source
        addresses = {"page": base, "stream": f"{base}{source}", "preview": f"{base}preview"}
        return {"name": self.name, "kind": self.kind, "live": self.live, "seconds": self.seconds, **addresses}


def list_page(streams: Sequence[Listed], *, query: str) -> str:
    """The page of all streams.

    Args:
        streams: in their order.
        query: what is added to every address: empty, or ``?token=...``.
    """
    entries = "\n".join(_entry(stream, query) for stream in streams)
    body = f"<h1>Streams</h1>\n<ul>\n{entries}\n</ul>" if streams else "<h1>Streams</h1>\n<p>There is none yet.</p>"
    refresh = f'<meta http-equiv="refresh" content="{REFRESH_SECONDS}">\n'
    return html_page("Streams", head=refresh + _STYLE, body=body, rules=policy())


def _entry(stream: Listed, query: str) -> str:
    address = html.escape(f"streams/{stream.name}/")
    tail = html.escape(query)
    state = '<span class="live">live</span>' if stream.live else _duration(stream.seconds)
    # A background, because a picture that is not ready yet would be shown as broken.
    picture = f'<i style="background-image:url(&quot;{address}preview{tail}&quot;)"></i>'
    return f'<li><a href="{address}{tail}">{picture}<p><span>{html.escape(stream.name)}</span>{state}</p></a></li>'


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return ""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"<span>{hours}:{minutes:02}:{rest:02}</span>" if hours else f"<span>{minutes}:{rest:02}</span>"
