# SPDX-License-Identifier: Apache-2.0
"""Checks whether a stream can be resumed, which requires the same configuration and capture."""

from collections.abc import Iterator, Mapping

from structgstream.cameras import CameraRig
from structgstream.codec.packets import StreamHeader
from structgstream.errors import ConfigError
from structgstream.session.pipeline import StreamFacts
from structgstream.session.presets import completed


def check_resumable(header: StreamHeader, facts: StreamFacts) -> None:
    """Check that a stream was made with the same method, configuration and capture.

    Raises:
        ConfigError: it was not; the message names the differences.
    """
    if header.codec != facts.codec:
        raise ConfigError(
            f"The stream was made by another method or codec, {header.codec!r} instead of {facts.codec!r}. "
            "Resume with the same, or start again with --overwrite."
        )
    differing = list(_differences(dict(completed(header.config)), dict(completed(facts.config))))
    if differing:
        raise ConfigError(
            f"The stream was made with another configuration: {', '.join(differing[:5])} differ. "
            "Resume with the same preset and options, or start again with --overwrite."
        )
    ours = _capture_facts(facts.rig, facts.fps, facts.metadata)
    differing = list(_differences(_capture_facts(header.rig, header.fps, header.metadata), ours))
    if differing:
        raise ConfigError(
            f"The stream was made from another capture or another part of it: {', '.join(differing[:5])} differ. "
            "Resume with the same capture and options, or start again with --overwrite."
        )


def _capture_facts(rig: CameraRig, fps: float, metadata: Mapping[str, object]) -> dict[str, object]:
    """The properties of a capture that must be equal to continue a stream, as plain values."""
    cameras = {
        name: {
            "viewmat": rig[name].viewmat.tolist(),
            "K": rig[name].K.tolist(),
            "size": [rig[name].width, rig[name].height],
            "near": rig[name].near,
            "held out": name in rig.held_out,
        }
        for name in rig
    }
    return {"order of cameras": [*rig], "cameras": cameras, "fps": fps, **metadata}


def _differences(old: object, new: object, path: str = "") -> Iterator[str]:
    """Paths at which two trees of plain JSON values differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}):
            yield from _differences(old.get(key), new.get(key), f"{path}.{key}" if path else key)
    elif old != new:
        yield path
