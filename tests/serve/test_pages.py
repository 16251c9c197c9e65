# SPDX-License-Identifier: Apache-2.0
"""The player's module, the pages that contain it and their policy, the list of streams, and files that grow."""

import base64
import gzip
import hashlib
import html
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from structgstream.codec.reader import StreamReader
from structgstream.errors import PlayerError, StorageError, StreamError
from structgstream.serve import pages
from structgstream.serve.pages import (
    REFRESH_SECONDS,
    StreamFile,
    bundle,
    check_has_header,
    inline_module,
    linked_page,
    list_page,
    single_page,
    write_page,
    write_site,
)
from tests.support.streams import small_stream

STREAM = small_stream()
PLAYING = {"autoplay": None, "loop": None}


class Elements(HTMLParser):
    """Tags with their attributes, and the content of scripts as a browser takes it."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.tags:
            self.texts.append((self.tags[-1][0], data))

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]

    def text(self, tag: str) -> str:
        return "".join(text for name, text in self.texts if name == tag)

    def all(self, tag: str, attribute: str) -> list[str]:
        return [found for given in self.of(tag) if (found := given.get(attribute))]

    @property
    def shown(self) -> list[str]:
        return [stripped for _, text in self.texts if (stripped := text.strip())]

    def policy(self) -> dict[str, str]:
        (rules,) = (m["content"] for m in self.of("meta") if m.get("http-equiv") == "Content-Security-Policy")
        assert rules is not None
        return dict(rule.split(" ", 1) for rule in rules.split("; "))


def scripts(text: str) -> list[tuple[str, str]]:
    """Attributes and content of every script element, by the rule that its first end tag ends it."""
    return re.findall(r"<script([^>]*)>(.*?)</script", text, re.DOTALL | re.IGNORECASE)


def test_a_page_holds_player_and_stream() -> None:
    module = 'export const end = "</script>"; /* </SCRIPT */'
    text = single_page("a clip", module=module, stream=STREAM).decode()
    (data, stored), (kind, inlined) = scripts(text)
    assert 'id="stream"' in data
    assert "application/octet-stream;base64" in data
    assert base64.b64decode(stored, validate=True) == STREAM
    assert kind == ' type="module"'
    assert inlined == 'export const end = "<\\/script>"; /* <\\/SCRIPT */'
    assert Elements(text).of("structgstream-player") == [{"src": "#stream", **PLAYING}]


def test_nothing_in_a_page_runs_but_the_player_and_nothing_is_fetched() -> None:
    text = single_page("a clip", module=bundle(), stream=STREAM).decode()
    rules = Elements(text).policy()
    inlined = scripts(text)[1][1]
    digest = base64.b64encode(hashlib.sha256(inlined.encode()).digest()).decode()
    assert rules["script-src"].split() == [f"'sha256-{digest}'", "blob:"]
    assert rules["default-src"] == "'none'"
    assert rules["worker-src"] == "blob:"
    assert set(rules["connect-src"].split()) == {"blob:", "data:"}
    assert rules["base-uri"] == rules["form-action"] == "'none'"
    allowed = {"'none'", "'self'", "'unsafe-inline'", "blob:", "data:", f"'sha256-{digest}'"}
    assert {source for sources in rules.values() for source in sources.split()} <= allowed


def test_a_page_for_a_server_loads_from_its_own_origin_only() -> None:
    found = Elements(linked_page("a clip", stream="stream.sgs"))
    assert [script["src"] for script in found.of("script")] == ["player.js"]
    assert found.of("structgstream-player") == [{"src": "stream.sgs", **PLAYING}]
    rules = found.policy()
    assert rules["connect-src"] == "'self' blob:"
    assert rules["script-src"] == "'self' blob:"
    addresses = [value for _, attributes in found.tags for name, value in attributes.items() if name in ("src", "href")]
    assert set(addresses) == {"player.js", "stream.sgs", "data:,"}


HOSTILE = ["</title><script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "<!--", "{{7*7}}", "a & b"]


@pytest.mark.parametrize("text", HOSTILE)
def test_names_stay_text(text: str) -> None:
    plain = linked_page("a", stream="b", attributes={"truth": "c"})
    found = Elements(linked_page(text, stream=text, attributes={"truth": text}))
    assert [tag for tag, _ in found.tags] == [tag for tag, _ in Elements(plain).tags]
    assert found.text("title").strip() == text
    assert found.of("structgstream-player") == [{"src": text, "truth": text, **PLAYING}]
    assert html.escape(text) in single_page(text, module="", stream=STREAM).decode()


def test_a_module_that_ends_its_element_is_escaped_and_a_comment_refused() -> None:
    assert inline_module("a</script b</Script>c</ script") == "a<\\/script b<\\/Script>c</ script"
    with pytest.raises(AssertionError, match="comment"):
        inline_module("x = '<!-- <script>'")


def test_a_stream_that_is_too_long_for_a_page_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "MAX_PAGE_STREAM_BYTES", len(STREAM) - 1)
    with pytest.raises(PlayerError, match="structgstream play"):
        single_page("a clip", module="", stream=STREAM)


MAX_COMPRESSED_BYTES = 82_000


def test_it_is_small() -> None:
    assert len(gzip.compress(bundle().encode(), 9)) <= MAX_COMPRESSED_BYTES


def test_it_states_its_licence_and_asks_nobody_for_anything() -> None:
    source = bundle()
    assert source.startswith("// SPDX-License-Identifier: Apache-2.0")
    addresses = {word for word in source.replace('"', " ").replace("`", " ").replace("'", " ").split() if "://" in word}
    assert all("www.w3.org" in address for address in addresses), addresses  # names of XML, never fetched


def test_an_installation_without_it_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "files", lambda _: tmp_path)
    with pytest.raises(PlayerError, match="reinstall structgstream"):
        bundle()


def listed(name: str, live: bool | None, seconds: float | None) -> dict[str, object]:
    """An entry of streams.json, as far as the page needs it."""
    base = f"streams/{name}/"
    return {"name": name, "live": live, "seconds": seconds, "page": base, "preview": f"{base}preview"}


STREAMS = [
    listed("studio", True, 12.0),
    listed("ball.sgs", None, None),
    listed("done", False, 3725.4),
    listed("short", False, 59.6),
]


def test_every_address_carries_the_query() -> None:
    seen = Elements(list_page(STREAMS, query="?token=v1.2.x"))
    assert seen.all("a", "href") == [f"streams/{one['name']}/?token=v1.2.x" for one in STREAMS]
    pictures = [re.fullmatch(r'background-image:url\("(.*)"\)', style) for style in seen.all("i", "style")]
    assert [found and found[1] for found in pictures] == [f"streams/{s['name']}/preview?token=v1.2.x" for s in STREAMS]


def test_live_streams_and_lengths_of_others() -> None:
    texts = Elements(list_page(STREAMS, query="")).shown
    shown = texts[texts.index("studio") :]
    assert shown == ["studio", "live", "ball.sgs", "done", "1:02:05", "short", "1:00"]


def test_a_list_without_streams_says_so_and_looks_again() -> None:
    page = list_page([], query="")
    assert "There is none yet." in Elements(page).shown
    assert "<ul>" not in page
    assert f'<meta http-equiv="refresh" content="{REFRESH_SECONDS}">' in page
    assert "There is none yet." not in list_page(STREAMS, query="")


@pytest.mark.parametrize("hostile", ['"><script>alert(1)</script>', "a&b<i>", "'x'"])
def test_names_and_queries_are_texts(hostile: str) -> None:
    """Names are checked before; the page does not rely on it."""
    seen = Elements(list_page([listed(hostile, None, None)], query=f"?token={hostile}"))
    assert hostile in seen.shown
    assert seen.all("a", "href") == [f"streams/{hostile}/?token={hostile}"]
    assert not seen.of("script")


HEADER_BYTES = StreamReader(STREAM).header_bytes


@pytest.fixture
def file(tmp_path: Path) -> StreamFile:
    return StreamFile(tmp_path / "s.sgs")


def test_it_begins_with_its_header_and_is_complete_with_its_footer(file: StreamFile) -> None:
    assert not file.has_header()
    for length in (0, 5, 12, 13, HEADER_BYTES - 1, HEADER_BYTES, HEADER_BYTES + 3, len(STREAM) - 1, len(STREAM)):
        file.path.write_bytes(STREAM[:length])
        assert file.has_header() == (length >= HEADER_BYTES)
        assert file.state() == {"bytes": length, "complete": length == len(STREAM)}


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty; expected a stream made by structgstream reconstruct"),
        (b"hello, this is no stream", "is not a structgstream file"),
        (STREAM[:10], "cut at byte 10"),
        (STREAM[: HEADER_BYTES - 1], f"cut at byte {HEADER_BYTES - 1}, within the record that begins at byte 12"),
        (STREAM[:8] + b"\x09\x00" + STREAM[10:], "version 9.0"),
    ],
)
def test_what_cannot_be_shown_is_reported(file: StreamFile, data: bytes, words: str) -> None:
    with pytest.raises(StreamError, match="No such file or directory"):
        file.check()
    file.path.write_bytes(data)
    with pytest.raises(StreamError, match=words):
        file.check()
    with pytest.raises(StreamError, match=words):
        check_has_header(data, "memory")


def test_a_site_never_replaces_its_own_stream(tmp_path: Path) -> None:
    path = tmp_path / "stream.sgs"
    path.write_bytes(STREAM)
    with pytest.raises(StorageError, match="is the stream itself"):
        write_site(tmp_path, StreamFile(path))
    assert path.read_bytes() == STREAM


def test_a_site_replaces_an_earlier_one_and_no_other_page(file: StreamFile, tmp_path: Path) -> None:
    file.path.write_bytes(STREAM)
    page = tmp_path / "www" / "index.html"
    for _ in range(2):
        write_site(page.parent, file)
    page.write_text("<h1>My pages</h1>")
    with pytest.raises(StorageError, match="is another page"):
        write_site(page.parent, file)
    assert page.read_text() == "<h1>My pages</h1>"


def test_what_cannot_be_shown_is_not_written(file: StreamFile, tmp_path: Path) -> None:
    file.path.write_bytes(STREAM[:100])
    for writing in (write_page, write_site):
        with pytest.raises(StreamError, match="cut at byte 100"):
            writing(tmp_path / "out", file)
    assert [entry.name for entry in tmp_path.iterdir()] == ["s.sgs"]
