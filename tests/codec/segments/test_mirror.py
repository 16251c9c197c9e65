# SPDX-License-Identifier: Apache-2.0
"""What follows the folder is whole at every moment, catches up after an outage, and never holds up the writer."""

import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from structgstream.codec.segments.manifest import MANIFEST, manifest_from_json
from structgstream.codec.segments.mirror import AnotherStreamError, MirroredStore, MirrorOptions
from structgstream.codec.segments.recovery import stale_files
from structgstream.codec.segments.sink import SegmentsOptions, SegmentsSink
from structgstream.codec.segments.store import FolderStore, Store
from structgstream.codec.segments.stored_bytes import StoredBytes, read_manifest
from structgstream.errors import StorageError
from structgstream.owned_folders import MARKER
from tests.support.segment_streams import Hands, as_file, folder, header, packets, written

SENT = packets(9)


class Remote(FolderStore):
    """A folder that can be out of reach, and that notes every manifest it gets with the files that are there."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.prepare()
        self.reachable = threading.Event()
        self.reachable.set()
        self.refused = threading.Semaphore(0)
        self.before: Callable[[str], object] = lambda name: None
        self.edges: list[int] = []

    def put(self, name: str, data: bytes) -> None:
        self._asked()
        self.before(name)
        if name == MANIFEST:
            manifest = manifest_from_json(data, name=name)
            StoredBytes(self, manifest, check=True)[:]
            self.edges.append(manifest.edge.frame)
        super().put(name, data)

    def delete(self, name: str) -> None:
        self._asked()
        assert name != MANIFEST, "readers have it at every moment"
        super().delete(name)

    def names(self) -> frozenset[str]:
        self._asked()
        return super().names()

    def _asked(self) -> None:
        if not self.reachable.is_set():
            self.refused.release()
            raise StorageError("No route to host.")


@pytest.fixture
def here(tmp_path: Path) -> FolderStore:
    return folder(tmp_path / "here")


@pytest.fixture
def remote(tmp_path: Path) -> Remote:
    return Remote(tmp_path / "remote")


def held_up(remote: Remote) -> tuple[threading.Event, threading.Event]:
    """Makes copying wait; the first event is set when it does, the second one lets it go on."""
    inside, done = threading.Event(), threading.Event()

    def before(name: str) -> None:
        if name != MARKER:
            inside.set()
            assert done.wait(60)

    remote.before = before
    return inside, done


def named(store: Store) -> dict[str, bytes]:
    """What the manifest names, and itself."""
    there = store.names()
    return {name: store.get(name) for name in there - stale_files(read_manifest(store), there)}


def check_copied(mirror: MirroredStore) -> None:
    assert mirror.finish(wait_seconds=60) == 0
    assert named(mirror._remote) == named(mirror._folder)


def test_everything_is_copied_and_every_manifest_is_whole(here: FolderStore, remote: Remote) -> None:
    written(mirror := MirroredStore(here, remote), SENT)
    check_copied(mirror)
    assert remote.edges == sorted(remote.edges)
    assert remote.edges[-1] == 8
    stored = StoredBytes(remote, read_manifest(remote), check=True)
    assert stored[: len(stored)] == as_file(SENT)


def test_the_writer_goes_on_while_the_other_store_cannot_be_reached(here: FolderStore, remote: Remote) -> None:
    reported: list[str] = []
    remote.reachable.clear()
    mirror = MirroredStore(here, remote, options=MirrorOptions(report=reported.append))
    written(mirror, SENT)
    for _ in range(2):
        assert remote.refused.acquire(timeout=60)
    assert read_manifest(here).edge.frame == 8
    assert remote.edges == []
    remote.reachable.set()
    check_copied(mirror)
    assert remote.edges == [8]  # Those before were replaced while they waited.
    assert len(reported) == 2
    assert "cannot be reached (No route to host.); the stream goes on in" in reported[0]
    assert "can be reached again" in reported[1]


def test_what_was_not_copied_is_reported_and_copied_by_the_next_run(here: FolderStore, remote: Remote) -> None:
    remote.reachable.clear()
    written(mirror := MirroredStore(here, remote), SENT)
    assert mirror.finish(wait_seconds=0.0) > 0
    remote.reachable.set()
    (remote.folder / "notes.txt").write_text("mine")
    again = MirroredStore(here, remote)
    again.copy_all()
    check_copied(again)
    assert (remote.folder / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("marked", [True, False])
def test_another_stream_is_never_replaced(tmp_path: Path, marked: bool) -> None:
    remote = Remote(tmp_path / "remote")
    written(first := MirroredStore(folder(tmp_path / "first"), remote), packets(4))
    assert first.finish(wait_seconds=60) == 0
    if not marked:
        (remote.folder / MARKER).unlink()
    before = contents(remote)
    with pytest.raises(AnotherStreamError, match="did not send"):
        MirroredStore(folder(tmp_path / "second"), remote).claim()
    assert contents(remote) == before


def test_another_stream_that_is_found_after_an_outage_is_not_replaced(tmp_path: Path) -> None:
    remote, reported = Remote(tmp_path / "remote"), list[str]()
    written(first := MirroredStore(folder(tmp_path / "first"), remote), packets(4))
    assert first.finish(wait_seconds=60) == 0
    before = contents(remote)
    options = MirrorOptions(grace_seconds=0.0, report=reported.append)
    second = MirroredStore(folder(tmp_path / "second"), remote, options=options)
    written(second, SENT)
    assert second.finish(wait_seconds=1.0) > 0
    assert contents(remote) == before
    assert len(reported) == 1
    assert "did not send" in reported[0]


def contents(store: FolderStore) -> dict[str, bytes]:
    """All files, by name."""
    return {path.name: path.read_bytes() for path in store.folder.iterdir()}


def test_a_copy_without_a_marker_is_known_by_its_first_record(here: FolderStore, remote: Remote) -> None:
    written(mirror := MirroredStore(here, remote), SENT)
    assert mirror.finish(wait_seconds=60) == 0
    for store in (here, remote):
        (store.folder / MARKER).unlink()
    MirroredStore(here, remote).claim()
    assert (here.folder / MARKER).read_bytes() == (remote.folder / MARKER).read_bytes()


def test_a_file_that_leaves_the_folder_leaves_the_other_store_after_its_grace(
    here: FolderStore, remote: Remote
) -> None:
    hands = Hands()
    options = MirrorOptions(grace_seconds=5.0, elapsed=lambda: hands.elapsed)
    mirror = MirroredStore(here, remote, options=options)
    kept = SegmentsOptions(grace_seconds=0.5)
    sent = packets(16)
    written(mirror, sent, options=kept, hands=hands, after=lambda _: _settle(mirror))
    assert mirror.finish(wait_seconds=60) == 0
    parts = [sorted(int(n.split("-")[1]) for n in store.names() if "part" in n) for store in (here, remote)]
    assert set(parts[0]) < set(parts[1])
    assert 0 not in parts[1]
    stored = StoredBytes(remote, read_manifest(remote), check=True)
    assert stored[: len(stored)] == as_file(sent)


def _settle(mirror: MirroredStore) -> None:
    with mirror._changed:
        assert mirror._changed.wait_for(lambda: not mirror._pending(), timeout=60)


def test_a_part_that_goes_while_it_waits_is_not_copied_and_no_manifest_names_it(
    here: FolderStore, remote: Remote
) -> None:
    """The outage is longer than the time of grace."""
    hands = Hands()
    remote.reachable.clear()
    mirror = MirroredStore(here, remote)
    written(mirror, SENT, options=SegmentsOptions(grace_seconds=0.5), hands=hands)
    remote.reachable.set()
    check_copied(mirror)
    assert not {int(name.split("-")[1]) for name in remote.names() if "part" in name} & {0, 1, 2}


def test_a_file_that_is_to_go_while_it_is_copied_goes_when_its_manifest_is_there(
    here: FolderStore, remote: Remote
) -> None:
    """A round that takes longer than the time of grace: a slow store, or much that waited."""
    written(here, SENT[:1])  # ends with a short segment, which another run replaces
    (short,) = (name for name in here.names() if name.startswith("segment"))
    reported: list[str] = []
    inside, done = held_up(remote)
    mirror = MirroredStore(here, remote, options=MirrorOptions(report=reported.append))
    mirror.copy_all()
    assert inside.wait(60)
    written(mirror, SENT, options=SegmentsOptions(grace_seconds=0.5))
    assert short in here.names()
    done.set()
    check_copied(mirror)
    assert remote.edges == [0, 8]  # The remote raises where a manifest names what is not there.
    assert reported == []
    assert short not in here.names()


def test_a_store_that_lost_files_while_it_failed_gets_them_again(here: FolderStore, remote: Remote) -> None:
    mirror = MirroredStore(here, remote)

    def after(frame: int) -> None:
        if frame != 4:
            return
        _settle(mirror)
        remote.reachable.clear()
        for name in FolderStore.names(remote):
            FolderStore.delete(remote, name)

    written(mirror, SENT, after=after)
    assert remote.refused.acquire(timeout=60)
    remote.reachable.set()
    check_copied(mirror)


@pytest.mark.parametrize("frame", [2, 3])
def test_a_killed_writer_is_followed_up(here: FolderStore, remote: Remote, frame: int) -> None:
    """The thread dies with the process, anywhere; the next run compares."""
    written(here, SENT[:frame])
    names = sorted(here.names() - {MANIFEST})
    for name in names[: frame + 1]:
        FolderStore.put(remote, name, here.get(name))
    written(mirror := MirroredStore(here, remote), SENT)
    check_copied(mirror)


def test_after_an_outage_only_what_is_named_is_copied(here: FolderStore, remote: Remote) -> None:
    """Parts of groups that are segments by now stay in the folder for the time of grace, and nobody asks for them."""
    copied: list[str] = []
    remote.before = copied.append
    remote.reachable.clear()
    mirror = MirroredStore(here, remote)
    written(mirror, packets(30))
    assert sum(name.startswith("part") for name in here.names()) == 30
    remote.reachable.set()
    check_copied(mirror)
    assert not any(name.startswith("part") for name in copied)
    assert len([name for name in copied if name.startswith("segment")]) == 10


def test_a_slow_store_is_behind_by_a_round_however_long_the_stream_is(here: FolderStore, remote: Remote) -> None:
    """The store takes as long for a file as three frames take: parts that were replaced meanwhile are left out."""
    turns, copied = threading.Semaphore(0), list[str]()

    def before(name: str) -> None:
        copied.append(name)
        assert turns.acquire(timeout=60)

    remote.before = before
    mirror = MirroredStore(here, remote)
    sent = packets(90)
    written(mirror, sent, after=lambda frame: frame % 3 == 2 and turns.release())
    for _ in range(200):
        turns.release()
    check_copied(mirror)
    assert len(copied) < 90


def test_a_store_that_is_filled_again_keeps_its_manifest(here: FolderStore, remote: Remote) -> None:
    hands = Hands()
    options = MirrorOptions(grace_seconds=5.0, elapsed=lambda: hands.elapsed)
    mirror = MirroredStore(here, remote, options=options)
    written(mirror, SENT, hands=hands)
    _settle(mirror)
    before = remote.names()
    sink = SegmentsSink(mirror, overwrite=True, clocks=hands.clocks())
    sink.open(header())
    _settle(mirror)
    assert remote.names() == before  # It has the old stream until the new one has a frame.
    for packet in SENT:
        sink.write(packet)
        _settle(mirror)
        hands.wait(1.0)
        StoredBytes(remote, read_manifest(remote), check=True)[:]
    sink.close()
    check_copied(mirror)


def test_what_comes_again_while_its_removal_waits_for_a_round_stays(here: FolderStore, remote: Remote) -> None:
    written(here, SENT[:1])
    (short,) = (name for name in here.names() if name.startswith("segment"))
    data = here.get(short)
    inside, done = held_up(remote)
    mirror = MirroredStore(here, remote)
    mirror.copy_all()
    assert inside.wait(60)
    mirror.delete(short)
    assert short in here.names(), "its removal waits"
    mirror.put(short, data)
    done.set()
    check_copied(mirror)
    assert short in here.names()


def test_what_an_earlier_run_has_left_is_removed_little_by_little(here: FolderStore, remote: Remote) -> None:
    hands = Hands()
    MirroredStore(here, remote).claim()
    for frame in range(100):
        FolderStore.put(remote, f"part-{frame:08d}-{frame:016x}.sgs", b"")
    options = MirrorOptions(grace_seconds=2.0, elapsed=lambda: hands.elapsed)
    mirror = MirroredStore(here, remote, options=options)
    left = []

    def after(frame: int) -> None:
        _settle(mirror)
        left.append(sum(name.endswith(".sgs") and "part-" in name for name in remote.names()))

    written(mirror, SENT, hands=hands, after=after)
    assert mirror.finish(wait_seconds=60) == 0
    assert 0 < max(before - later for before, later in pairwise(left)) < 20
