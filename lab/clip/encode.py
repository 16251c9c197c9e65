# SPDX-License-Identifier: Apache-2.0
"""Packs the rendered pictures: ``python lab/clip/encode.py table build/clip src/structgstream/data/clip``.

Writes one H.264 file a camera and ``cameras.json``, decodes them and prints their PSNR against the pictures.
"""

import argparse
import json
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rig import FPS, FRAMES, RIGS, Rig

Pictures = NDArray[np.uint8]
RED, GREEN, BLUE = 0.2126, 0.7152, 0.0722  # luma weights of BT.709


def yuv_planes(rgb: Pictures) -> Pictures:
    """BT.709 limited range ``[3, H, W]`` from ``rgb [H, W, 3]``: exact, where a scaler rounds twice."""
    x = rgb / 255.0
    luma = x @ [RED, GREEN, BLUE]
    blue = (x[..., 2] - luma) / (2 * (1 - BLUE))
    red = (x[..., 0] - luma) / (2 * (1 - RED))
    return np.rint(np.stack([16 + 219 * luma, 128 + 224 * blue, 128 + 224 * red])).astype(np.uint8)


def encode(path: Path, pictures: Pictures, *, quality: int, psy: bool = True) -> None:
    """Writes ``pictures [T, H, W, 3]`` as 4:4:4 H.264 of constant rate factor ``quality``.

    ``psy`` are x264's psychovisual decisions, which cost PSNR: without them a file of the same size is 0.8 dB nearer.
    """
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream(
            "libx264",
            rate=FPS,
            options={
                "crf": str(quality),
                "preset": "veryslow",
                "psy": str(int(psy)),
                "g": str(len(pictures)),
                "threads": "1",
                "flags": "+bitexact",
            },
        )
        height, width = pictures.shape[1:3]
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv444p"
        context = stream.codec_context
        context.bit_rate = 0  # a rate left at its default would win over the constant quality
        context.color_range, context.colorspace, context.color_primaries, context.color_trc = 1, 1, 1, 1
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame(width, height, "yuv444p")
            for plane, values in zip(frame.planes, yuv_planes(picture), strict=True):
                padded = np.zeros((height, plane.line_size), np.uint8)
                padded[:, :width] = values
                plane.update(padded.tobytes())
            frame.pts, frame.time_base = number, Fraction(1, FPS)
            frame.color_range, frame.colorspace = 1, 1
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def decode(path: Path) -> Pictures:
    """All frames of a video as ``[T, H, W, 3]``."""
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def psnr(a: Pictures, b: Pictures) -> float:
    """Peak signal-to-noise ratio in dB of 8-bit pictures."""
    error = np.mean((a.astype(np.float64) - b) ** 2)
    return float(10 * np.log10(255**2 / error))


def description(rig: Rig, frames: int) -> dict[str, object]:
    """The content of ``cameras.json``."""
    views = rig.views()
    return {
        "width": rig.width, "height": rig.height, "fps": FPS, "frames": frames, "held_out": [views[0].name],
        "cameras": {view.name: {"K": view.K.tolist(), "viewmat": view.viewmat.tolist()} for view in views},
        "convention": "viewmat: world to camera, OpenCV axes (x right, y down, z forward), world z up; "
        "the top-left pixel's centre is (0.5, 0.5)",
        "units": "metres", "near": rig.near_metres, "licence": "CC0-1.0",
        "renderer": "Mitsuba 3 path tracing with Open Image Denoise, lab/clip/scene.py",
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", choices=sorted(RIGS))
    parser.add_argument("pictures", type=Path, help="folder written by scene.py")
    parser.add_argument("out", type=Path, help="folder for the videos and cameras.json")
    parser.add_argument("--frames", type=int, default=FRAMES, help="how many there are")
    parser.add_argument("--crf", type=int, default=9, help="x264 constant rate factor")
    parser.add_argument(
        "--psy", action=argparse.BooleanOptionalAction, default=True, help="x264's psychovisual decisions"
    )
    options = parser.parse_args()
    rig = RIGS[options.scene]
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "cameras.json").write_text(json.dumps(description(rig, options.frames), indent=1) + "\n")
    for view in rig.views():
        files = [options.pictures / f"{view.name}_{frame:02d}.png" for frame in range(options.frames)]
        pictures = np.stack([np.asarray(Image.open(file).convert("RGB")) for file in files])
        path = options.out / f"{view.name}.mp4"
        encode(path, pictures, quality=options.crf, psy=options.psy)
        print(f"{path.name}: {path.stat().st_size} bytes, {psnr(decode(path), pictures):.2f} dB")


if __name__ == "__main__":
    main()
