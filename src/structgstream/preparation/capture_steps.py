# SPDX-License-Identifier: Apache-2.0
"""The steps that make the capture: its files, near plane, points, and the check."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_file
from structgstream.cameras import CameraRig
from structgstream.data.calibration import NEAR_IN_RIG_RADII
from structgstream.data.camera_files import REPORT
from structgstream.data.masks import FOLDER as MASKS
from structgstream.data.open import best_surrounded, open_capture
from structgstream.data.points import initial_points
from structgstream.data.prepared import (
    PreparedCamera,
    PreparedCapture,
    prepared_entries,
    prepared_rig,
    write_prepared,
)
from structgstream.data.source import FrameSource
from structgstream.data.timeline import Clock
from structgstream.data.undistortion import rectilinear
from structgstream.data.video import measured_fps
from structgstream.data.wrappers import WithRig
from structgstream.pose_check.findings import Finding
from structgstream.preparation.calibration.solved import SolvedCalibration
from structgstream.preparation.checking.check import Examination, check_capture, examine_capture
from structgstream.preparation.checking.overlap import nearest_depth, observed_depths
from structgstream.preparation.footage import Footage
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.output_folder import link, remove_others, unlink
from structgstream.preparation.steps import FOLDER, Job, Stored, fingerprint
from structgstream.similarity import rig_radius

POINTS = "points.npy"
NEAR_SHARE = 0.5  # of the depth of the nearest points: what comes closer later is still drawn


class CaptureSteps:
    """The steps of one preparation from a calibration on.

    Args:
        job: what is prepared, and how.
    """

    def __init__(self, job: Job) -> None:
        self.videos, self.capture, self.options = job.videos, job.capture, job.options
        self.steps = job.steps
        self.examination: Examination | None = None  # which two steps look at
        self._opened: FrameSource | None = None

    def link(self, footage: Footage, content: PreparedCapture) -> None:
        self.steps.begin("link")
        for number, (name, camera) in enumerate(content.cameras.items()):
            self.steps.progress(number, len(content.cameras), name)
            target = self.capture / camera.files
            source = footage.path(name)
            if not footage.tracks and source.is_file():
                target = target / source.name
            link(source, target, how=self.options.link)
            if not footage.tracks:
                remove_others(self.capture / camera.files, [file.name for file in footage.stills[name]])
        self._link_masks()
        write_prepared(self.capture, content)
        how = {"hard": "hard link or copy", "symlink": "symlink", "copy": "copy"}[self.options.link]
        self.steps.end("link", f"{len(content.cameras)} cameras by {how}")

    def _link_masks(self) -> None:
        """All masks but those of cameras that are left out; these are removed where an earlier run linked them."""
        folder = self.videos / MASKS
        for entry in sorted(folder.iterdir()) if folder.is_dir() else ():
            target = self.capture / MASKS / entry.name
            if (entry.name if entry.is_dir() else entry.stem) in self.options.without:
                unlink(entry, target)
            else:
                link(entry, target, how=self.options.link)

    def near(self, content: PreparedCapture) -> PreparedCapture:
        """With the near plane from the points that pictures confirm."""
        if self.options.near is not None:
            return content

        def measure() -> float | None:
            self.examination = examine_capture(self._source(content))
            return nearest_depth(observed_depths(self.examination.tracks, self.examination.cameras))

        nearest = self.steps.run(
            "near",
            self._inputs(content),
            measure,
            pack=lambda found: Stored({"nearest": found}),
            unpack=lambda stored: stored.values["nearest"],
            summary=lambda found: "too few points: 0.12 rig radii" if found is None
            else f"{NEAR_SHARE * found:.3g}, half of the depth of the nearest points",
            after=("synchronize",),
        )  # fmt: skip
        content = content if nearest is None else replace(content, near=NEAR_SHARE * nearest)
        write_prepared(self.capture, content)
        return content

    def points(self, content: PreparedCapture) -> PreparedCapture:
        def estimate() -> NDArray[np.float64]:
            source = self._source(content)
            return initial_points(next(source.frames(0)), source.rig).positions

        found = self.steps.run(
            "points",
            self._inputs(content),
            estimate,
            pack=lambda points: Stored({}, {"points": points}),
            unpack=lambda stored: stored.arrays["points"],
            summary=lambda points: f"{len(points):,} points of frame 0",
            after=("synchronize",),
        )  # fmt: skip
        with atomic_file(self.capture / POINTS) as file:
            np.save(file, found)
        content = replace(content, points=POINTS)
        write_prepared(self.capture, content)
        return content

    def check(self, content: PreparedCapture) -> tuple[Finding, ...]:
        from structgstream.preparation.report import write_report

        def look() -> tuple[Finding, ...]:
            source = self._source(content)
            checked = check_capture(source, unit=content.unit, listener=self.steps, examination=self.examination)
            checked = replace(checked, report=replace(checked.report, steps=dict(self.steps.summaries)))
            write_report(self.capture / REPORT, checked, listener=self.steps)
            return checked.report.findings

        if not (self.capture / REPORT / "index.html").is_file():
            (self.capture / FOLDER / "check.json").unlink(missing_ok=True)
        return self.steps.run(
            "check",
            self._inputs(content),
            look,
            pack=lambda findings: Stored({"findings": [asdict(finding) for finding in findings]}),
            unpack=lambda stored: tuple(
                Finding(found["severity"], found["sentence"], tuple(found["cameras"]))
                for found in stored.values["findings"]
            ),
            summary=lambda findings: f"{len(findings)} finding{'s' * (len(findings) != 1)}; {REPORT}/index.html",
            after=("points",),
        )

    def _inputs(self, content: PreparedCapture) -> dict[str, object]:
        """All that frames depend on, but for what was filmed."""
        inputs: dict[str, object] = {"content": json.dumps(prepared_entries(content))}
        if (masks := self.capture / MASKS).is_dir():
            inputs["masks"] = fingerprint({"masks": masks})
        return inputs

    def _source(self, content: PreparedCapture) -> FrameSource:
        """The capture, opened once: indexing videos takes time, and its warnings should come once."""
        if self._opened is None:
            self._opened = open_capture(self.capture)
        points = None
        if content.points is not None:
            points = np.asarray(np.load(self.capture / content.points, allow_pickle=False), np.float64)
        return _Grown(self._opened, prepared_rig(self.capture, content), points)


@dataclass(frozen=True)
class _Grown(WithRig):
    """An opened capture with the near plane and the points that were found since."""

    found: NDArray[np.float64] | None

    @property
    def points(self) -> NDArray[np.float64] | None:
        return self.found


def held_out_of(options: PrepareOptions, rig: CameraRig) -> frozenset[str]:
    """The cameras to hold out."""
    return frozenset({best_surrounded(rig)} if options.held_out == ("auto",) else options.held_out)


def assembled(
    footage: Footage,
    clocks: Mapping[str, Clock],
    solved: SolvedCalibration,
    options: PrepareOptions,
) -> PreparedCapture:
    """The content of ``capture.json`` with the usual near plane, without points.

    Raises:
        ConfigError: a field of view or size that cannot be.
        CalibrationError: a lens that cannot be undistorted.
    """
    cameras = {}
    for name in footage.cameras:
        filmed = solved.cameras[name]
        pinhole = rectilinear(filmed, degrees=options.field_of_view, size=options.size)
        where = f"videos/{name}{footage.path(name).suffix.lower()}" if footage.tracks else f"pictures/{name}"
        cameras[name] = PreparedCamera(where, filmed, pinhole, clocks.get(name, Clock()))
    rig = CameraRig({name: camera.pinhole for name, camera in cameras.items()})
    held_out = held_out_of(options, rig)
    near = options.near or NEAR_IN_RIG_RADII * rig_radius(rig.with_held_out(held_out))
    fps = measured_fps(footage.tracks, clocks) if footage.tracks else None
    return PreparedCapture(cameras, fps or footage.fps, near, "metres" if solved.metres else "arbitrary", held_out)
