# SPDX-License-Identifier: Apache-2.0
"""A file is whole or not there, in every format."""

import resource
from pathlib import Path

import pytest

from exporters.plain import some
from structgstream.errors import StorageError
from structgstream.exporters.formats import FORMATS, Format
from structgstream.exporters.write import write_gaussians


@pytest.mark.parametrize("format", FORMATS)
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
