# SPDX-License-Identifier: Apache-2.0
"""A file is whole or not there, in every format."""

import resource
from pathlib import Path

import pytest

from structgstream.cameras import Similarity
from structgstream.errors import StorageError, StreamError
from structgstream.exporters.formats import Format
from structgstream.exporters.write import FORMAT_BYTES, write_gaussians
from tests.support.plain import some


@pytest.mark.parametrize("format", FORMAT_BYTES)
def test_a_full_disk_leaves_the_old_file(format: Format, tmp_path: Path) -> None:
    path = tmp_path / f"set.{format}"
    path.write_bytes(b"old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))  # files stop at 2000 bytes, as on a full disk
    try:
        with pytest.raises(StorageError, match="cannot be written"):
            write_gaussians(path, some(), format=format)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("format", FORMAT_BYTES)
@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_values_that_no_file_can_hold_are_refused(format: Format, scale: float, tmp_path: Path) -> None:
    gaussians = some().in_capture_units(Similarity((0.0, 0.0, 0.0), scale))
    with pytest.raises(StreamError, match="Gaussians are infinite, zero or no numbers.*inspect shows the similarity"):
        write_gaussians(tmp_path / "set", gaussians, format=format)
    assert not [*tmp_path.iterdir()]
