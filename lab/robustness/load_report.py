# SPDX-License-Identifier: Apache-2.0
"""A result of ``lab.robustness.load`` as Markdown."""

import statistics
from typing import Any


def table(result: dict[str, Any]) -> str:
    """All tables."""
    live, spans = result["live"], result["live"]["spans"]
    load = result["load_average"]
    lines = [
        "| players | trainer: seconds a frame, median (frames) | busy seconds | seconds without a core | write, ms | "
        "server's memory, MB | processor seconds of server, players |",
        "|---|---|---|---|---|---|---|",
        *(_span(one) for one in spans),
        "",
        *_ratio(spans),
        *_players(spans),
        f"Server: {live['server']['before_bytes'] / 1e6:.0f} MB before, {live['server']['max_bytes'] / 1e6:.0f} MB at "
        f"most; {live['server']['processor_seconds']:.1f} processor seconds in {live['server']['seconds']:.0f} s.",
        "",
        "| files | server | MB/s | answers a second | processor ms an answer | serve is times (MB/s) | exact |",
        "|---|---|---|---|---|---|---|",
        *(row for kind, found in result["throughput"].items() for row in _servers(kind, found)),
        "",
        f"Load average before {load['before']}, after {load['after']}.",
    ]
    return "\n".join(lines)


def _span(one: dict[str, Any]) -> str:
    fit, busy = _median(one["fit_seconds"]), _median(one["busy_seconds"])
    # Results before both were measured lack them.
    write, waited = _median(one["write_seconds"]), _median(one.get("waited_seconds", []))
    busy_of = one.get("processor_seconds")
    others = "-" if busy_of is None else f"{busy_of['server']:.1f}, {busy_of['players']:.1f}"
    return (
        f"| {one['players']} | {_shown(fit)} ({len(one['fit_seconds'])}) | {_shown(busy)} | {_shown(waited)} | "
        f"{_shown(None if write is None else 1000 * write)} | {one['server_bytes'] / 1e6:.0f} | "
        f"{others} |"
    )


def _ratio(spans: list[dict[str, Any]]) -> list[str]:
    """With players over without, of neighbouring spans."""
    lines = []
    for what, name in (("seconds", "fit_seconds"), ("busy seconds", "busy_seconds")):
        found = []
        for alone, together in zip(spans[::2], spans[1::2], strict=True):
            before, after = _median(alone[name]), _median(together[name])
            if before and after:
                found.append(after / before)
        lines.append(f"{what} with players over without, round by round: {', '.join(f'{one:.2f}' for one in found)}")
    return [f"Trainer's {'; '.join(lines)}.", ""]


def _players(spans: list[dict[str, Any]]) -> list[str]:
    lines = [
        "| fast: exact of | frames | joined, s: median, last | behind, s: median, 95% | MB | slow: kB/s | cut off |"
    ]
    lines.append("|---|---|---|---|---|---|---|")
    for one in (span for span in spans if span["players"]):
        fast, slow, joined = one["fast"], one["slow"], one["joined_seconds"]
        rate = slow["bytes"] / max(slow["players"], 1) / one["seconds"] / 1e3
        delay = fast["delay_seconds"]
        lines.append(
            f"| {fast['exact']} of {fast['players']} | {fast['least_frames']} to {fast['most_frames']} | "
            f"{_shown(joined['median'])}, {joined['most']:.1f} | {_shown(delay['median'])}, {_shown(delay['95%'])} | "
            f"{fast['bytes'] / 1e6:.0f} | {rate:.1f} | {fast['broken'] + slow['broken']} |"
        )
    return [*lines, ""]


def _servers(kind: str, found: dict[str, Any]) -> list[str]:
    size = found["mean_bytes"]
    files = f"{kind}, {size / 1e3:.0f} kB"
    return [
        f"| {files} | {server} | {one['megabytes_per_second']:.0f} | {one['answers_per_second']:.0f} | "
        f"{one['busy_ms_an_answer']:.2f} | "
        f"{one['serve_is_times']:.2f} | {'yes' if one['exact'] else 'NO'} |"
        for server, one in found["servers"].items()
    ]


def _median(values: list[float]) -> float | None:
    return statistics.median(values) if values else None


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
