# SPDX-License-Identifier: Apache-2.0
"""``structgstream demo``."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import Interrupted, UsageError
from structgstream.cli.evaluate import quality_text, report_tables
from structgstream.cli.options import Device, Number, PresetName, check_ending, parse_known_options, resolve_config
from structgstream.cli.progress import print_lines

SLOWED = 0.2  # twelve frames at full speed take only 0.4 s


@dataclass(frozen=True)
class Demo:
    """Reconstructs the bundled clip, scores it, and writes pictures, videos and a page with a player; takes minutes on
    two processor cores.

    Example: structgstream demo --output demo
    """

    output: Annotated[Path, tyro.conf.arg(metavar="FOLDER", aliases=["-o"])] = Path("demo")
    """Output folder; files of an earlier demo are replaced."""
    frames: Number = None
    """Number of frames. Default: all twelve."""
    scale: float = 1.0
    """Size of the pictures relative to the clip's."""
    device: Device = "auto"
    """Compute back-end."""
    preset: PresetName = None
    """Preset of the configuration. Default: fast."""


def main(arguments: list[str]) -> None:
    """Runs the demo."""
    options, rest = parse_known_options(Demo, "demo", arguments=arguments)
    check_ending(options.output, command="demo", folder=True)
    if options.output.exists() and not options.output.is_dir():
        raise UsageError(f"--output is a folder, and {options.output} is a file.")
    from structgstream.cli.evaluate import run_evaluation
    from structgstream.cli.reconstruct import run_reconstruction
    from structgstream.cli.render import path_pictures, write_pictures
    from structgstream.codec.reader import open_stream
    from structgstream.data.dataset_layouts import bundled_clip_path
    from structgstream.data.open import open_capture
    from structgstream.evaluation.evaluate import compared_frames
    from structgstream.evaluation.pictures import side_by_side
    from structgstream.kernels.backend import select_backend
    from structgstream.recorder import check_output
    from structgstream.serve.pages import StreamFile, write_page
    from structgstream.session.presets import DEMO_PRESET

    began, console = time.perf_counter(), Console()
    config, preset = resolve_config(options.preset or DEMO_PRESET, rest, command="demo", seed=None)
    source = open_capture(bundled_clip_path(), scale=options.scale, frames=options.frames)
    backend = select_backend(options.device)
    folder, camera = options.output, source.rig.testing[0]
    stream, player, report_folder = folder / "clip.sgs", folder / "player.html", folder / "report"
    held_out, orbit = folder / "held-out.mp4", folder / "orbit.mp4"
    check_output(stream, may_exist=True)
    console.print(
        f"Reconstructing the bundled clip: {len(source.rig.training)} training cameras of "
        f"{source.rig[camera].width}x{source.rig[camera].height}, {len(source)} frames, preset {preset}, back-end "
        f"{backend.name}.",
        highlight=False,
    )
    metadata = {"preset": preset, "start": 0, "scale": options.scale}
    try:
        run_reconstruction(source, config, output=stream, backend=backend, metadata=metadata)
    except Interrupted:
        raise Interrupted(f"What was done is in {folder}; the demo starts again from the beginning.") from None

    reader = open_stream(stream)
    report = run_evaluation(reader, source, stream=stream, backend=backend, cameras=None, folder=report_folder)
    pairs = compared_frames(reader, source, backend=backend, camera=camera)
    write_pictures(held_out, (side_by_side(*pair) for pair in pairs), fps=source.fps * SLOWED)
    write_pictures(orbit, path_pictures(reader, backend, path="orbit", camera=camera), fps=source.fps)
    write_page(player, StreamFile(stream))

    console.print(report_tables(report, title="bundled clip, held-out camera"))
    console.print()
    for name, path in (
        ("stream", stream),
        ("worst frames", report_folder / "index.html"),
        ("pictures", report_folder / "contact_sheet.png"),
        ("plots", report_folder / "over_time.png"),
        ("numbers", report_folder / "report.json"),
        ("held-out view", f"{held_out} (truth, rendering, difference x4; a fifth of the speed)"),
        ("moving camera", orbit),
    ):
        print_lines(console, f"{name:<14}  {path}")
    seconds = time.perf_counter() - began
    console.print(
        f"\nHeld-out PSNR {quality_text(report)} over {len(report.frames)} frames, everything in {seconds:.0f} s.",
        highlight=False,
    )
    print_lines(
        console,
        f"\nWatch it from any angle: open {player} in a browser,\n{player.resolve().as_uri()}\n"
        f"or, next to the cameras' pictures: structgstream play {stream} --capture {bundled_clip_path()}",
    )
