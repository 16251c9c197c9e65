# SPDX-License-Identifier: Apache-2.0
"""A Ray cluster of two machines, which are network namespaces of this one, and strangers that want to join it.

    sudo python -m lab.robustness.ray_machines

``head`` and ``node`` have an address and a token each, and a worker of one thread. A driver on ``head`` runs a parallel
job of ``tests/support/stand_in.py`` on both; then ``stranger`` tries to run a task without a token, and with another
one. Needs root, for the namespaces, and the package ray.
"""

import json
import os
import re
import secrets
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lab.robustness.parallel_faults import driven, engine, job_in
from structgstream.executors.ray_cluster import RayEngine
from structgstream.executors.tasks import Task, TaskQueue
from structgstream.parallel.driver import drive
from structgstream.parallel.parts import Parts

NAMES = ("head", "node", "stranger")
NETWORK = "10.77.0"
PORT = 6379
BRIDGE = "sgsbridge"
PATIENCE_SECONDS = 60


def address(name: str) -> str:
    """Of a machine."""
    return f"{NETWORK}.{NAMES.index(name) + 1}"


def ip(*words: str, check: bool = True) -> None:
    """Configures the network."""
    subprocess.run(["ip", *words], check=check, stderr=None if check else subprocess.DEVNULL)


@contextmanager
def machines() -> Iterator[None]:
    """Three network namespaces on one bridge."""
    try:
        ip("link", "add", BRIDGE, "type", "bridge")
        ip("link", "set", BRIDGE, "up")
        for name in NAMES:
            space = f"sgs-{name}"
            ip("netns", "add", space)
            ip("link", "add", f"sgs{name}", "type", "veth", "peer", "name", "eth0", "netns", space)
            ip("link", "set", f"sgs{name}", "master", BRIDGE, "up")
            ip("-n", space, "addr", "add", f"{address(name)}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                ip("-n", space, "link", "set", device, "up")
        yield
    finally:
        for name in NAMES:
            ip("netns", "delete", f"sgs-{name}", check=False)
            ip("link", "delete", f"sgs{name}", check=False)
        ip("link", "delete", BRIDGE, check=False)


def on(name: str, *command: str, token: Path | None, mode: str = "token") -> subprocess.Popen[str]:
    """Begins a command on a machine."""
    variables = {key: value for key, value in os.environ.items() if not key.startswith("RAY_")}
    variables |= {"RAY_AUTH_MODE": mode, "RAY_USAGE_STATS_ENABLED": "0", "HOME": str(Path("/nonexistent"))}
    if token is not None:
        variables["RAY_AUTH_TOKEN_PATH"] = str(token)
    words = ["ip", "netns", "exec", f"sgs-{name}", *command]
    return subprocess.Popen(words, env=variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@contextmanager
def ray_node(name: str, *options: str, token: Path, folder: Path) -> Iterator[None]:
    """A Ray node on a machine, ended afterwards."""
    program = str(Path(sys.executable).with_name("ray"))
    words = [program, "start", "--block", "--num-cpus=1", f"--node-ip-address={address(name)}", "--disable-usage-stats"]
    process = on(name, *words, "--object-store-memory=83886080", *options, token=token)
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(PATIENCE_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
        (folder / f"{name}.txt").write_text(process.stdout.read() if process.stdout else "")


def in_the_cluster(folder: Path) -> dict[str, object]:
    """What a driver on ``head`` does: a parallel run, and a count of the machines that tasks ran on."""
    begun = time.monotonic()
    joined = RayEngine(f"{address('head')}:{PORT}")
    result: dict[str, object] = {"seconds to join": round(time.monotonic() - begun, 2)}
    end = time.monotonic() + PATIENCE_SECONDS
    while joined.workers() < 2 and time.monotonic() < end:
        time.sleep(1)
    result["workers"] = joined.workers()
    with TaskQueue(joined) as executor:
        for i in range(20):
            where = "sleep 0.3; ip -4 -o addr show dev eth0"
            executor.submit(Task(f"where-{i}", ("sh", "-c", where)))
        outputs = []
        while len(outputs) < 20:
            outputs += [ending.output for ending in executor.wait(1.0)]
        found = (re.search(r"inet ([\d.]+)/", output) for output in outputs)
        result["tasks by machine"] = dict(Counter(match[1] for match in found if match))
        parts, given = Parts(folder / "ray" / "parts"), job_in(folder / "ray", real=False)
        begun = time.monotonic()
        with parts.locked():
            drive(given, parts, executor)
        result["seconds of the run"] = round(time.monotonic() - begun, 2)
        result["bytes equal"] = given.output.read_bytes() == (folder / "local" / "out.sgs").read_bytes()
    return result


STRANGER = """
import ray
ray.init(address={address!r}, log_to_driver=False, logging_level="ERROR")
@ray.remote(num_cpus=0)
def taken(): return "taken over"
print(ray.get(taken.remote(), timeout=20))
"""


def stranger(*, token: Path | None, mode: str) -> str:
    """What comes of one that wants to run a task; the last line that it hears."""
    code = STRANGER.format(address=f"{address('head')}:{PORT}")
    process = on("stranger", sys.executable, "-c", code, token=token, mode=mode)
    try:
        said, _ = process.communicate(timeout=PATIENCE_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return "no answer"
    lines = [line for line in said.splitlines() if line.strip()]
    return f"status {process.returncode}: {lines[-1][:200] if lines else ''}"


def measured(folder: Path) -> dict[str, object]:
    """Everything."""
    tokens = {}
    for name in ("cluster", "other"):
        tokens[name] = folder / f"{name}.token"
        tokens[name].write_text(secrets.token_hex(32))
        tokens[name].chmod(0o600)
    driven(folder / "local", engine(), real=False)
    token = tokens["cluster"]
    head = ("--head", f"--port={PORT}", "--include-dashboard=false", f"--temp-dir={folder / 'r'}")
    with (
        machines(),
        ray_node("head", *head, token=token, folder=folder),
        ray_node("node", f"--address={address('head')}:{PORT}", token=token, folder=folder),
    ):
        driver = on("head", sys.executable, "-m", "lab.robustness.ray_machines", "--driver", str(folder), token=token)
        said, _ = driver.communicate(timeout=5 * PATIENCE_SECONDS)
        if driver.returncode:
            raise SystemExit(said)
        result = json.loads(said.splitlines()[-1])
        result["stranger without a token"] = stranger(token=None, mode="disabled")
        result["stranger with another token"] = stranger(token=tokens["other"], mode="token")
        result["one with the token"] = stranger(token=token, mode="token")
    return result


def main() -> None:
    """Run, and print what came of it."""
    if sys.argv[1:2] == ["--driver"]:
        print(json.dumps(in_the_cluster(Path(sys.argv[2]))))
        return
    with tempfile.TemporaryDirectory() as name:
        for what, value in measured(Path(name)).items():
            print(f"{what}: {value}")


if __name__ == "__main__":
    main()
