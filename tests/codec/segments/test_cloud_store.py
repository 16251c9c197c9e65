# SPDX-License-Identifier: Apache-2.0
"""An object store holds a stream as a folder does: S3, by an emulator on this machine, and fsspec's memory."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.mirror import MirroredStore, MirrorOptions
from structgstream.codec.segments.recovery import stale_files
from structgstream.codec.segments.store import CloudStore
from structgstream.codec.segments.stored_bytes import read_manifest, write_archive
from structgstream.errors import MissingExtraError, StorageError, StreamError
from tests.support.s3_emulator import BUCKET, Emulator, emulator
from tests.support.segment_streams import as_file, folder, packets, written

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")

SENT = packets(7)


@pytest.fixture(scope="module")
def server() -> Iterator[Emulator]:
    with emulator() as running:
        yield running


def s3(server: Emulator, name: str) -> CloudStore:
    return CloudStore(f"s3://{BUCKET}/{name}/", **server.options)


def test_objects_are_written_replaced_listed_and_removed(server: Emulator) -> None:
    store = s3(server, "plain")
    assert store.names() == frozenset()
    store.put(MANIFEST, b"1")
    store.put(MANIFEST, b"22")
    assert (store.get(MANIFEST), store.names(), store.free_bytes()) == (b"22", {MANIFEST}, None)
    store.delete(MANIFEST)
    store.delete(MANIFEST)
    assert store.names() == frozenset()
    with pytest.raises(StreamError, match=r"Cannot read manifest\.json in s3://streams/plain"):
        store.get(MANIFEST)


def test_browsers_are_reported_what_may_be_cached(server: Emulator) -> None:
    store = s3(server, "headers")
    written(store, SENT[:1])
    found = {}
    for name in store.names():
        info = store._files.call_s3("head_object", Bucket=BUCKET, Key=f"headers/{name}")
        found[name.split("-")[0]] = (info["ContentType"], info["CacheControl"])
    forever = "public, max-age=31536000, immutable"
    assert found[MANIFEST] == ("application/json", "no-cache")
    assert found["segment"] == ("application/octet-stream", forever)


def test_a_stream_is_written_to_s3_stopped_continued_and_archived(server: Emulator, tmp_path: Path) -> None:
    store = s3(server, "direct")
    written(store, SENT[:4])
    assert read_manifest(store).edge.frame == 3
    written(store, SENT)
    assert write_archive(store, tmp_path / "a.sgs") == 7
    assert (tmp_path / "a.sgs").read_bytes() == as_file(SENT)


def test_an_outage_of_s3_costs_nothing(server: Emulator, tmp_path: Path) -> None:
    here, reported = folder(tmp_path / "here"), []
    mirror = MirroredStore(here, s3(server, "outage"), options=MirrorOptions(report=reported.append))

    def outage(frame: int) -> None:
        if frame == 2:
            server.stop()

    written(mirror, SENT, after=outage)
    assert mirror.finish(wait_seconds=3.0) > 0
    server.start()
    again = MirroredStore(here, s3(server, "outage"))
    again.copy_all()
    assert again.finish(wait_seconds=60) == 0
    store = s3(server, "outage")
    replaced = stale_files(read_manifest(here), here.names())
    assert here.names() - replaced <= store.names() <= here.names()
    write_archive(store, tmp_path / "a.sgs")
    assert (tmp_path / "a.sgs").read_bytes() == as_file(SENT)


def test_what_cannot_be_reached_is_reported_in_words(server: Emulator) -> None:
    store = CloudStore(f"s3://no-such-bucket-{BUCKET}/x", **server.options)
    with pytest.raises(StorageError, match="Cannot write 1 bytes to manifest.json in s3://no-such-bucket"):
        store.put(MANIFEST, b"1")


def test_other_file_systems(tmp_path: Path) -> None:
    for url in ("memory://stream", f"file://{tmp_path}/stream"):
        store = CloudStore(url)
        written(store, SENT)
        write_archive(store, tmp_path / "a.sgs")
        assert (tmp_path / "a.sgs").read_bytes() == as_file(SENT)
        store.delete(MANIFEST)
        assert MANIFEST not in store.names()


def test_a_scheme_that_needs_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StorageError, match="nowhere://x cannot be used as a store"):
        CloudStore("nowhere://x")
    monkeypatch.setitem(__import__("sys").modules, "fsspec.core", None)
    with pytest.raises(MissingExtraError, match=r"structgstream\[cloud\]"):
        CloudStore("s3://x")
