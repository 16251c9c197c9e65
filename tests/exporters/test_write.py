# SPDX-License-Identifier: Apache-2.0
"""A file is whole or not there, in every format."""

from pathlib import Path

import pytest

from structgstream.cameras import Similarity
from structgstream.errors import StreamError
from structgstream.exporters.formats import Format
from structgstream.exporters.write import FORMAT_BYTES, write_gaussians
from tests.support.plain import some


@pytest.mark.parametrize("format", FORMAT_BYTES)
@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_values_that_no_file_can_hold_are_refused(format: Format, scale: float, tmp_path: Path) -> None:
    gaussians = some().in_capture_units(Similarity((0.0, 0.0, 0.0), scale))
    with pytest.raises(StreamError, match="Gaussians are infinite, zero or no numbers.*inspect shows the similarity"):
        write_gaussians(tmp_path / "set", gaussians, format=format)
    assert not [*tmp_path.iterdir()]
