# SPDX-License-Identifier: Apache-2.0
from structgstream.data.dataset_layouts import bundled_clip, bundled_clip_path


def test_the_bundled_clip_is_a_capture() -> None:
    source = bundled_clip()
    assert (len(source.rig), len(source), source.name) == (10, 12, "clip")
    assert source.rig.testing
    frame = next(source.frames(11))
    assert frame.index == 11
    assert {image.shape for image in frame.images.values()} == {(240, 320, 3)}
    assert (bundled_clip_path() / "cameras.json").is_file()
