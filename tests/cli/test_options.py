# SPDX-License-Identifier: Apache-2.0
"""What options come to: the part of a capture, a configuration edited by paths; and what doctor says is there."""

import importlib.metadata
import json
from pathlib import Path

import pytest

from structgstream.cli import doctor
from structgstream.cli.app import UsageError
from structgstream.cli.groups import Join
from structgstream.cli.options import (
    CaptureOptions,
    open_selected_capture,
    parse_known_options,
    parse_options,
    resolve_config,
)
from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.kernels import backend
from structgstream.session.presets import DEFAULT_PRESET, PRESETS
from tests.support.quick_streams import Runner


def test_options_of_a_capture_choose_its_part() -> None:
    arguments = ["--held-out", "cam01", "cam02", "--scale", "0.25", "--start", "3", "--frames", "4", "--near", "0.5"]
    arguments += ["--every", "2"]
    options = parse_options(CaptureOptions, "reconstruct", arguments=arguments)
    assert options == CaptureOptions(("cam01", "cam02"), 0.25, 3, 4, 2, 0.5)
    source = open_selected_capture(Path(bundled_clip_path()), options)
    assert (len(source), source.fps) == (4, 15.0)
    assert source.rig.testing == ("cam01", "cam02")
    camera = source.rig["cam00"]
    assert (camera.width, camera.height, camera.near) == (80, 60, 0.5)


def test_the_camera_best_surrounded_is_held_out_on_request() -> None:
    options = parse_options(CaptureOptions, "reconstruct", arguments=["--held-out", "auto"])
    assert open_selected_capture(Path(bundled_clip_path()), options).rig.testing == ("cam00",)


def test_what_is_no_option_of_the_command_is_left_over() -> None:
    options, rest = parse_known_options(
        CaptureOptions, "reconstruct", arguments=["--online.iterations", "50", "--start", "2", "--codec", "raw"]
    )
    assert options == CaptureOptions(start=2)
    assert rest == ["--online.iterations", "50", "--codec", "raw"]


def test_a_configuration_is_a_preset_with_edits() -> None:
    config, name = resolve_config(None, [], command="reconstruct", seed=None)
    assert (config, name) == (PRESETS[DEFAULT_PRESET], DEFAULT_PRESET)
    config, name = resolve_config("tiny", ["--online.iterations", "7"], command="reconstruct", seed=9)
    assert (config.online.iterations, config.seed, name) == (7, 9, "tiny")
    assert config.initial == PRESETS["tiny"].initial


def test_no_command_writes_a_file_of_another_kind(run: Runner, tmp_path: Path) -> None:
    for arguments in (
        ["archive", "x", "-o", "a.mp4"],
        ["join", "x.sgs", "-o", "a.html"],
        ["parallel", "x", "-o", "a.ply"],
        ["export", "x.sgs", "-o", "a.mov", "--format", "ply"],
        ["evaluate", "x.sgs", "x", "--json", "x.sgs"],
        ["evaluate", "x.sgs", "x", "--report", "a.html"],
        ["inspect", "x.sgs", "--json", "x.sgs"],
        ["prepare", "x", "-o", "a.mp4"],
        ["board", "-o", "a.png"],
        ["track", "x", "--init", "h.sgs", "-o", "h.sgs"],
    ):
        said = run(arguments, status=2).err
        assert "writes no ." in said
        assert not said.rstrip().endswith("writes .")


def test_a_path_is_what_a_shell_makes_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    options = parse_options(Join, "join", arguments=["~/a.sgs", "b.sgs", "-o", "~/c.sgs"])
    assert options.segments == (tmp_path / "a.sgs", Path("b.sgs"))
    assert options.output == tmp_path / "c.sgs"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    options = parse_options(Join, "join", arguments=[".", "folder/..", "-o", "c.sgs"])
    assert options.segments == (tmp_path.resolve(), tmp_path.resolve())
    with pytest.raises(UsageError, match="output '-' would be a file"):
        parse_options(Join, "join", arguments=["a.sgs", "-o", "-"])
    with pytest.raises(UsageError, match="no user"):
        parse_options(Join, "join", arguments=["a.sgs", "-o", "~no-such-user/a"])


def test_json_to_standard_output_is_nothing_else(run: Runner) -> None:
    printed = run(["doctor", "--json", "-"])
    assert json.loads(printed.out).keys() == {"environment", "backends", "packages"}
    assert "back-end" in printed.err


def test_everything_is_listed(tmp_path: Path, run: Runner) -> None:
    text = run(["doctor", "--json", str(tmp_path / "d.json")]).out
    found = json.loads((tmp_path / "d.json").read_text())
    assert [entry["name"] for entry in found["backends"]] == ["cuda", "cpu", "reference"]
    assert sum(entry["state"].startswith("chosen") for entry in found["backends"]) == 1
    names = {"av", "cv2", "scipy", "yaml", "matplotlib", "starlette", "uvicorn", "s3fs", "anywidget"}
    names |= {"prometheus_client", "pxr", "fourdgs", "PIL", "pycolmap", "ray"}
    assert {entry["name"] for entry in found["packages"]} == names
    assert "reference" in text
    assert "cores" in text
    for entry in found["packages"]:
        assert entry["version"] or f"structgstream[{entry['extra']}]" in text


def test_what_is_missing_comes_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    reasons = {"cuda": "No GPU here.", "cpu": None, "reference": None}
    monkeypatch.setattr(backend, "backend_reasons", lambda: reasons)
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    found = doctor.diagnose()
    assert [entry["state"] for entry in found["backends"]] == ["missing", "chosen by --device auto", "available"]
    assert found["backends"][0]["advice"] == "No GPU here."
    advice = {entry["name"]: entry["advice"] for entry in found["packages"]}
    assert "pip install 'structgstream[capture]'" in advice["av"]
    assert "pip install 'structgstream[report]'" in advice["matplotlib"]


def test_a_package_that_was_copied_has_no_version(monkeypatch: pytest.MonkeyPatch) -> None:
    found, missing = doctor.diagnose(), importlib.metadata.PackageNotFoundError
    there = {entry["name"] for entry in found["packages"] if entry["version"]}

    def no_metadata(name: str) -> str:
        raise missing(name)

    monkeypatch.setattr(importlib.metadata, "version", no_metadata)
    versions = {entry["name"]: entry["version"] for entry in doctor.diagnose()["packages"]}
    assert there
    assert versions == {name: "without a version" if name in there else None for name in versions}
