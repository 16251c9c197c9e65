# SPDX-License-Identifier: Apache-2.0
"""Figures that the paper prints for itself and other methods: cited unchanged, not measured here.

They were obtained with captures, cameras, machines and programs that this project does not have, so they are in
separate tables. The paper states only for 3DGStream's frame rate that it was measured again by its authors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from structgstream.errors import ConfigError
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.sheets import Sheet
from structgstream_studies.experiments.summary import score_of

NOTHING = "-"


@dataclass(frozen=True)
class CitedRow:
    """One method as the paper prints it; means over the frames of all scenes.

    Args:
        kind: every frame from scratch, offline on the whole sequence, or online.
        method: its name there.
        psnr: dB.
        megabytes: per frame, without the initial model if the paper has both.
        with_initial: per frame, "considering the initial model": the paper's star.
        minutes: training time per frame.
        fps: rendered pictures per second.
    """

    kind: str
    method: str
    psnr: str
    megabytes: str
    with_initial: str
    minutes: str
    fps: str


@dataclass(frozen=True)
class CitedTable:
    """One table of the paper.

    Args:
        data: the data set, as the paper uses it.
        rows: in the paper's order.
        remarks: what the paper says below it.
    """

    data: str
    rows: Sequence[CitedRow]
    remarks: Sequence[str] = ()


_STATIC, _OFFLINE, _ONLINE = "every frame from scratch", "offline", "online"
_OURS = "Struct-GStream"

CITED: Mapping[str, CitedTable] = {
    "n3dv": CitedTable(
        "N3DV, 21 cameras, 1352 x 1014, 300 frames a scene",
        (
            CitedRow(_STATIC, "Plenoxels", "30.77", "4106", NOTHING, "23", "8.3"),
            CitedRow(_STATIC, "I-NGP", "28.62", "48.2", NOTHING, "1.3", "2.9"),
            CitedRow(_STATIC, "3DG-S", "32.08", "47.1", NOTHING, "8.3", "390"),
            CitedRow(_STATIC, "Scaffold-GS", "32.25", "24.5", NOTHING, "1.9", "90"),
            CitedRow(_OFFLINE, "DyNeRF", "29.58", "0.1", NOTHING, "260", "0.02"),
            CitedRow(_OFFLINE, "NeRFPlayer", "30.69", "17.1", NOTHING, "1.2", "0.05"),
            CitedRow(_OFFLINE, "HexPlane", "31.70", "0.8", NOTHING, "2.4", "0.21"),
            CitedRow(_OFFLINE, "K-Planes", "31.63", "1.0", NOTHING, "0.8", "0.9"),
            CitedRow(_OFFLINE, "HyperReel", "31.10", "1.2", NOTHING, "1.8", "2.00"),
            CitedRow(_OFFLINE, "MixVoxels", "30.80", "1.7", NOTHING, "0.27", "16.7"),
            CitedRow(_OFFLINE, "RealTime4DGS", "29.95", "17.7", NOTHING, "1.6", "73"),
            CitedRow(_OFFLINE, "4DGaussians", "30.88", "0.21", NOTHING, "0.22", "78"),
            CitedRow(_OFFLINE, "SpacetimeGaussians", "32.05", "0.7", NOTHING, "0.90", "140"),
            CitedRow(_ONLINE, "StreamRF", "30.68", "17.7", "31.4", "0.25", "8.3"),
            CitedRow(_ONLINE, "iFVC", "31.88", "0.12", "0.14", "0.24", "70"),
            CitedRow(_ONLINE, "3DGStream", "30.97", "7.6", "7.8", "0.20", "160"),
            CitedRow(_ONLINE, _OURS, "31.72", "4.7", "4.8", "0.14", "120"),
        ),
        (
            "DyNeRF is of the scene *flame salmon* only.",
            "3DGStream's pictures a second were measured again by the paper's authors.",
        ),
    ),
    "meetroom": CitedTable(
        "Meet Room, 12 training cameras and 1 for testing, 1280 x 720, 300 frames a scene",
        (
            CitedRow(_STATIC, "Plenoxels", "27.15", "1015", NOTHING, "14", "10"),
            CitedRow(_STATIC, "I-NGP", "28.10", "48.2", NOTHING, "1.1", "4.1"),
            CitedRow(_STATIC, "3DG-S", "31.31", "21.1", NOTHING, "2.6", "571"),
            CitedRow(_STATIC, "Scaffold-GS", "31.52", "17.7", NOTHING, "2.8", "108"),
            CitedRow(_ONLINE, "StreamRF", "26.72", "5.7", "9.0", "0.17", "10"),
            CitedRow(_ONLINE, "iFVC", "31.16", "0.09", "0.10", "0.15", "74"),
            CitedRow(_ONLINE, "3DGStream", "30.45", "4.0", "4.1", "0.10", "197"),
            CitedRow(_ONLINE, _OURS, "30.95", "2.97", "3.02", "0.08", "123"),
        ),
    ),
    "immersive": CitedTable(
        "Google Immersive, 46 fisheye cameras undistorted, 1 of them for testing, 1280 x 960",
        (
            CitedRow(_ONLINE, "iFVC", "28.65", "0.14", "0.16", "0.70", "56"),
            CitedRow(_ONLINE, "3DGStream", "27.69", "8.5", "8.7", "0.41", "135"),
            CitedRow(_ONLINE, _OURS, "28.48", "5.2", "5.4", "0.26", "96"),
        ),
    ),
}


def online_rows(name: str) -> list[CitedRow]:
    """The online methods of a data set."""
    return [row for row in CITED[name].rows if row.kind == _ONLINE]


def cited_sheet(name: str) -> Sheet:
    """The table of a data set; every cell is the paper's.

    Raises:
        ConfigError: the paper has no such data set.
    """
    if name not in CITED:
        raise ConfigError(f"Nothing is cited of {name!r}; there are {', '.join(CITED)}.")
    heads = ["cited method", "kind", "PSNR, dB", "MB a frame", "with the initial model, MB a frame"]
    heads += ["training, min a frame", "pictures a second"]
    rows = [
        [row.method, row.kind, row.psnr, row.megabytes, row.with_initial, row.minutes, row.fps]
        for row in CITED[name].rows
    ]
    return Sheet(f"Cited: {CITED[name].data}", heads, rows)


def dataset_sheet(data: str, results: Sequence[Result], *, name: str) -> Sheet:
    """The paper's rows of a data set, and below them ours: the mean over captures of the means over seeds.

    Args:
        data: the data set.
        results: of every capture and seed; the training is that of frames after the first, as the machine took it.
        name: what made them.

    Raises:
        ConfigError: the paper has no such data set.
    """
    cited = cited_sheet(data)
    captures: dict[str, list[Result]] = {}
    for result in results:
        captures.setdefault(result.identity["capture"]["name"], []).append(result)

    def mean(score: str, digits: int, factor: float = 1.0) -> str:
        by_capture = [[score_of(result, score) for result in found] for found in captures.values()]
        values = [[value for value in found if value is not None] for found in by_capture]
        if not values or not all(values):
            return NOTHING
        return f"{factor * sum(sum(found) / len(found) for found in values) / len(values):.{digits}f}"

    ours = [
        f"ours: {name}, {len(captures)} captures ({', '.join(captures)})",
        _ONLINE,
        mean("psnr", 2),
        mean("online_bytes", 2, 1e-6),
        mean("bytes_with_header", 2, 1e-6),
        mean("online_seconds", 2, 1 / 60),
        mean("decode_and_render_fps", 0),
    ]
    rows = [[f"cited: {row[0]}", *row[1:]] for row in cited.rows]
    return Sheet(f"{CITED[data].data}, and ours", ["method", *cited.columns[1:]], [*rows, ours])


def cited_words(name: str) -> str:
    """The text above the table: source and data set of the figures."""
    table = CITED[name]
    return " ".join([f"**Cited from the paper, not measured here:** {table.data}.", *table.remarks]) + "\n"
