# SPDX-License-Identifier: Apache-2.0
"""The list of streams, as a page and as values."""

import re
from html.parser import HTMLParser

import pytest

from structgstream.server.pages import LIST_POLICY, REFRESH_SECONDS, Listed, list_page


class Seen(HTMLParser):
    """Elements with their attributes, and the texts of a page's body."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.texts.append(data.strip())

    def all(self, tag: str, attribute: str) -> list[str]:
        return [found for name, given in self.elements if name == tag and (found := given.get(attribute))]


STREAMS = [
    Listed("studio", "segments", True, 12.0),
    Listed("ball.sgs", "file", None, None),
    Listed("done", "segments", False, 3725.4),
    Listed("short", "segments", False, 59.6),
]


def test_entries_as_values() -> None:
    assert STREAMS[0].as_json() == {
        "name": "studio", "kind": "segments", "live": True, "seconds": 12.0, "page": "streams/studio/",
        "stream": "streams/studio/manifest.json", "preview": "streams/studio/preview",
    }  # fmt: skip
    assert STREAMS[1].as_json()["stream"] == "streams/ball.sgs/stream.sgs"


def test_every_address_carries_the_query() -> None:
    seen = Seen(list_page(STREAMS, query="?token=v1.2.x"))
    assert seen.all("a", "href") == [f"streams/{one.name}/?token=v1.2.x" for one in STREAMS]
    pictures = [re.fullmatch(r'background-image:url\("(.*)"\)', style) for style in seen.all("i", "style")]
    assert [found and found[1] for found in pictures] == [f"streams/{s.name}/preview?token=v1.2.x" for s in STREAMS]


def test_live_streams_and_lengths_of_others() -> None:
    texts = Seen(list_page(STREAMS, query="")).texts
    shown = texts[texts.index("studio") :]
    assert shown == ["studio", "live", "ball.sgs", "done", "1:02:05", "short", "1:00"]


def test_a_list_without_streams_says_so_and_looks_again() -> None:
    page = list_page([], query="")
    assert "There is none yet." in Seen(page).texts
    assert "<ul>" not in page
    assert f'<meta http-equiv="refresh" content="{REFRESH_SECONDS}">' in page
    assert "There is none yet." not in list_page(STREAMS, query="")


@pytest.mark.parametrize("hostile", ['"><script>alert(1)</script>', "a&b<i>", "'x'"])
def test_names_and_queries_are_texts(hostile: str) -> None:
    """Names are checked before; the page does not rely on it."""
    seen = Seen(list_page([Listed(hostile, "file", None, None)], query=f"?token={hostile}"))
    assert hostile in seen.texts
    assert seen.all("a", "href") == [f"streams/{hostile}/?token={hostile}"]
    assert not any(tag == "script" for tag, _ in seen.elements)


def test_nobody_else_may_frame_the_list() -> None:
    assert "frame-ancestors 'self'" in LIST_POLICY
    assert "default-src 'none'" in LIST_POLICY
