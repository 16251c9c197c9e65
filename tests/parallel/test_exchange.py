# SPDX-License-Identifier: Apache-2.0
"""Machines that share no folder: parts meet in a store, whatever of its requests fails, and the bytes are the same."""

from pathlib import Path

import pytest

from structgstream.parallel import exchange
from structgstream.parallel.driver import drive
from structgstream.parallel.exchange import ObjectFolder, ObjectStore
from structgstream.parallel.parts import Parts
from tests.support.flaky_store import flaky_store
from tests.support.stand_ins import job, sha256, workers


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
        exchange = ObjectStore(ObjectFolder(url), parts)
        drive(job(folder / "b", frames=8), parts, executor, exchange=exchange)
    return folder / "b" / "out.sgs"


def test_a_run_by_a_store_gives_the_same_bytes(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRUCTGSTREAM_SCRATCH", str(tmp_path / "scratch"))
    url = f"file://{tmp_path / 'store'}"
    assert sha256(stored(tmp_path, url)) == sha256(plain)
    assert (tmp_path / "store" / "segments" / "group-000004-000008.sgs").exists()
    assert not any((tmp_path / "scratch").iterdir())
    # A driver on another machine, with nothing but the store, goes on there.
    (tmp_path / "store" / "segments" / "group-000004-000008.sgs").unlink()
    (tmp_path / "parts").rename(tmp_path / "lost")
    assert sha256(stored(tmp_path, url)) == sha256(plain)


def test_a_store_that_refuses_every_third_request_costs_only_time(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("s3fs", reason="s3fs, of the extra cloud, is not installed")
    pytest.importorskip("moto.server", reason="moto, of the extra dev, is not installed")
    monkeypatch.setenv("STRUCTGSTREAM_SCRATCH", str(tmp_path / "scratch"))
    monkeypatch.setattr(exchange, "FIRST_DELAY_SECONDS", 0.001)
    with flaky_store(3) as (url, application):
        assert sha256(stored(tmp_path, url)) == sha256(plain)
        assert application.refused >= 10
