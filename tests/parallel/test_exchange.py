# SPDX-License-Identifier: Apache-2.0
"""Machines that share no folder: files of commands come from a store and go to it, whatever of its requests fails."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from structgstream.errors import StorageError
from structgstream.owned_folders import MARKER, Owner
from structgstream.parallel import exchange
from structgstream.parallel.driver import Unit, drive
from structgstream.parallel.exchange import TRIES, ObjectFolder, ObjectStore, Staging, Transfer
from structgstream.parallel.parts import Parts
from tests.support.flaky_store import flaky_store
from tests.support.sleepers import is_gone, wait_for
from tests.support.stand_ins import job, sha256, workers


@pytest.fixture(autouse=True)
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange, "FIRST_DELAY_SECONDS", 0.0)
    monkeypatch.setattr(exchange, "POLL_SECONDS", 0.01)
    monkeypatch.setenv(exchange.SCRATCH, str(tmp_path / "scratch"))


@pytest.fixture
def store(tmp_path: Path) -> ObjectFolder:
    return ObjectFolder(f"file://{tmp_path / 'store'}")


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stream of a run without a store."""
    folder = tmp_path_factory.mktemp("plain")
    with Parts(folder / "plain").locked(), workers() as executor:
        drive(job(folder, frames=8), Parts(folder / "plain"), executor)
    return folder / "out.sgs"


def stored(folder: Path, url: str) -> Path:
    """The stream of a run with one."""
    parts = Parts(folder / "parts")
    (folder / "b").mkdir(exist_ok=True)
    with parts.locked(), workers() as executor:
        drive(job(folder / "b", frames=8), parts, executor, exchange=ObjectStore(ObjectFolder(url), parts))
    return folder / "b" / "out.sgs"


def test_a_run_by_a_store_gives_the_same_bytes(plain: Path, tmp_path: Path) -> None:
    url = f"file://{tmp_path / 'store'}"
    assert sha256(stored(tmp_path, url)) == sha256(plain)
    assert (tmp_path / "store" / "segments" / "group-000004-000008.sgs").exists()
    assert not scratch(tmp_path)
    # A driver on another machine, with nothing but the store, goes on there.
    (tmp_path / "store" / "segments" / "group-000004-000008.sgs").unlink()
    (tmp_path / "parts").rename(tmp_path / "lost")
    assert sha256(stored(tmp_path, url)) == sha256(plain)


def test_a_store_that_refuses_every_third_request_costs_only_time(plain: Path, tmp_path: Path) -> None:
    pytest.importorskip("s3fs", reason="s3fs, of the extra cloud, is not installed")
    pytest.importorskip("moto.server", reason="moto, of the extra dev, is not installed")
    with flaky_store(3) as (url, application):
        assert sha256(stored(tmp_path, url)) == sha256(plain)
        assert application.refused >= 10


def test_what_is_written_is_read(store: ObjectFolder) -> None:
    for name, data in (("a", b""), ("deep/b", b"b" * 1000), ("deep/b", b"new")):
        store.write(name, data)
        assert (store.read(name), store.size(name)) == (data, len(data))


def test_what_is_not_there_is_none(store: ObjectFolder) -> None:
    assert store.read("a") is None
    assert store.size("a") is None
    assert store.owner() is None
    store.remove(re.compile(".*"))


def test_only_a_marked_folder_is_emptied_and_only_of_what_is_named(store: ObjectFolder, tmp_path: Path) -> None:
    owner = Owner.new("parts of a parallel run")
    store.write("deep/b", b"b")
    for action in (store.owner, lambda: store.remove(re.compile(".*"))):
        with pytest.raises(StorageError, match="may be somebody else's; nothing there was changed"):
            action()
    assert store.read("deep/b") == b"b"
    store.write(MARKER, owner.content)
    (tmp_path / "store" / "mine.txt").write_text("mine")
    assert store.owner() == owner
    store.remove(re.compile("deep/.*"))
    assert store.read("deep/b") is None
    assert (tmp_path / "store" / "mine.txt").read_text() == "mine"
    assert store.owner() == owner


@pytest.mark.parametrize("failures", [TRIES - 1, TRIES])
def test_failures_are_tried_again_so_often(store: ObjectFolder, monkeypatch: pytest.MonkeyPatch, failures: int) -> None:
    store.write("a", b"content")
    real, left = store._files.cat_file, [failures]

    def failing(*arguments: Any) -> bytes:
        left[0] -= 1
        if left[0] >= 0:
            raise ConnectionError("the cable is out")
        return real(*arguments)

    monkeypatch.setattr(store._files, "cat_file", failing)
    if failures < TRIES:
        assert store.read("a") == b"content"
    else:
        with pytest.raises(StorageError, match="the cable is out"):
            store.read("a")


def run(store: ObjectFolder, script: str, **files: Any) -> int:
    """The status of a command with these files, whose first word is the folder of this machine."""
    with pytest.MonkeyPatch.context() as variables:
        variables.setenv(exchange.STORE, store.url)
        return exchange.run(Transfer("task", **files), ["sh", "-c", script, exchange.HERE])


def scratch(tmp_path: Path) -> list[Path]:
    return [*(tmp_path / "scratch").iterdir()] if (tmp_path / "scratch").exists() else []


def test_needs_are_fetched_and_results_stored(store: ObjectFolder, tmp_path: Path) -> None:
    store.write("in/a", b"content")
    script = 'mkdir -p "$0/out" && tr a-z A-Z < "$0/in/a" > "$0/out/b" && [ ! -e "$0/absent" ]'
    assert run(store, script, needs=("in/a", "absent"), gives=("out/b",)) == 0
    assert store.read("out/b") == b"CONTENT"
    assert not scratch(tmp_path)


def test_what_a_killed_command_has_left_is_not_taken_and_stays_here(store: ObjectFolder, tmp_path: Path) -> None:
    store.write("a", b"a")
    files = {"needs": ("a",), "gives": ("b",)}
    assert run(store, 'echo half > "$0/b"; exit 137', **files) == 137
    assert store.read("b") is None
    # The next attempt finds it.
    assert run(store, 'grep -q half "$0/b"', **files) == 0
    assert store.read("b") == b"half\n"
    assert not scratch(tmp_path)


def test_what_a_failing_command_has_left_is_removed(store: ObjectFolder, tmp_path: Path) -> None:
    assert run(store, 'echo half > "$0/b"; exit 3', gives=("b",)) == 3
    assert not scratch(tmp_path)


def test_a_command_ends_with_the_process_that_stages_it(store: ObjectFolder, tmp_path: Path) -> None:
    script = f"echo $$ > {tmp_path}/pid.new; mv {tmp_path}/pid.new {tmp_path}/pid; exec sleep 60"
    words = [sys.executable, "-m", exchange.__name__, json.dumps(asdict(Transfer("task"))), "sh", "-c", script]
    process = subprocess.Popen(words, env={**os.environ, exchange.STORE: store.url})
    wait_for(tmp_path / "pid")
    process.kill()
    process.wait()
    assert is_gone(int((tmp_path / "pid").read_text()))


def test_a_run_that_was_begun_anew_finds_nothing_of_the_one_before(store: ObjectFolder, tmp_path: Path) -> None:
    files = {"needs": ("header",), "gives": ("b",)}
    store.write("header", b"old")
    assert run(store, 'echo half > "$0/b"; exit 137', run="1", **files) == 137
    store.write("header", b"new")
    assert run(store, 'grep -q new "$0/header"; [ -e "$0/b" ]; exit 137', run="1", **files) == 137
    (other,) = scratch(tmp_path)
    mine = other.with_name(other.name.replace("-1", "-mine"))
    mine.mkdir()
    assert run(store, 'grep -q new "$0/header" && [ ! -e "$0/b" ]', run="2", **files) == 0
    assert scratch(tmp_path) == [mine], "a folder without a marker stays"


def test_a_result_of_before_is_brought_to_be_checked(store: ObjectFolder) -> None:
    store.write("b", b"before\n")
    assert run(store, 'grep -q before "$0/b"', gives=("b",)) == 0


def test_growing_files_are_stored_before_the_command_ends(store: ObjectFolder, tmp_path: Path) -> None:
    """It waits for what the store has of its files, so that it would not end otherwise."""
    stored = tmp_path / "store"
    script = f"""
echo groups > "$0/t.groups"; printf abc > "$0/t.partial"
until [ -e "{stored}/t.groups" ] && [ "$(cat "{stored}/t.partial")" = abc ]; do sleep 0.01; done
printf de >> "$0/t.partial"
until [ "$(cat "{stored}/t.partial")" = abcde ]; do sleep 0.01; done
printf f >> "$0/t.partial"; mv "$0/t.partial" "$0/t"
"""
    store.write("unused", b"")
    assert run(store, script, grows=("t.groups", "t.partial"), gives=("t",)) == 0
    assert store.read("t") == b"abcdef"


def test_a_growing_file_goes_on_here_or_on_another_machine(store: ObjectFolder, tmp_path: Path) -> None:
    files = {"grows": ("t.partial",), "gives": ("t",)}
    store.write("t.partial", b"abc")
    assert run(store, 'printf d >> "$0/t.partial"; exit 137', **files) == 137
    store.write("t.partial", b"of another attempt")
    assert run(store, 'printf e >> "$0/t.partial"; exit 137', **files) == 137
    assert store.read("t.partial") == b"abcde"
    shutil.rmtree(tmp_path / "scratch")
    store.write("t", b"whole")
    assert run(store, '[ ! -e "$0/t.partial" ]', **files) == 0, "a whole file is not one that grows"


def test_a_growing_file_is_stored_when_it_is_a_tenth_longer(store: ObjectFolder, tmp_path: Path) -> None:
    staging, path = Staging(store, tmp_path / "here"), tmp_path / "here" / "t"
    path.parent.mkdir()
    for content, ended, stored in (
        (b"a" * 100, False, 100),
        (b"a" * 105, False, 100),
        (b"a" * 120, False, 120),
        (b"a" * 90, False, 90),
        (b"a" * 91, True, 91),
    ):
        path.write_bytes(content)
        staging.put_growing("t", ended=ended)
        assert store.size("t") == stored


def test_a_command_that_is_killed_ends_this_process_the_same_way(store: ObjectFolder, tmp_path: Path) -> None:
    words = [json.dumps(asdict(Transfer("task", grows=("t.partial",)))), "sh", "-c"]
    script = 'printf abc > "$0/t.partial"; kill -9 $$'
    done = subprocess.run(
        [sys.executable, "-m", "structgstream.parallel.exchange", *words, script, exchange.HERE],
        env={**os.environ, exchange.STORE: store.url, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        check=False,
    )
    assert done.returncode == -signal.SIGKILL
    assert store.read("t.partial") == b"abc", "what had grown is in the store"
    assert len(scratch(tmp_path)) == 1, "and here, for the next attempt"


def test_a_store_that_cannot_be_used_is_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(exchange.STORE, "nonsense://a")
    monkeypatch.setattr(sys, "argv", ["exchange", json.dumps({"name": "task"}), "true"])
    assert exchange.main() == 1
    error = capsys.readouterr().err
    assert error.startswith("structgstream: nonsense://a cannot be used as a store (")
    assert error.count("\n") == 1


def test_the_url_of_the_store_is_on_no_command_line(tmp_path: Path) -> None:
    """It may hold credentials, and every user of a machine sees command lines."""
    url = f"file://{tmp_path / 'secret'}"
    parts = Parts(tmp_path / "a.parts")
    task = ObjectStore(ObjectFolder(url), parts).header(Unit("capture").header_task(parts))
    assert not any("secret" in word for word in task.command)
    assert task.environment[exchange.STORE] == url
