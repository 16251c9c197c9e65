# SPDX-License-Identifier: Apache-2.0
"""The engine ``ray``: tasks run on the machines of a Ray cluster, or of one that is started on this machine.

Note [Ray's ports]: anybody with access to a cluster's ports can run any code on all of its machines. So a cluster is
joined or started only with token authentication, which Ray supports from 2.52 on and does not enable by default.
"""

import os
import secrets
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from structgstream.errors import ConfigError, import_extra
from structgstream.executors.tasks import CommandProcess, Task, TaskResult, thread_environment, waited_for

OLDEST = (2, 52)
OBJECT_STORE_BYTES = 80 * 2**20
"""The smallest size that Ray accepts; only commands and results are transferred."""
IN_FLIGHT = 2
"""Tasks submitted to Ray per worker: one runs, and one is queued to follow it."""
COUNT_SECONDS = 10.0
"""Largest age of the cached number of workers."""
TOKEN_FILE = Path(".ray") / "auth_token"


class RayEngine:
    """Runs tasks on a Ray cluster.

    Args:
        address: ``HOST:PORT`` of the cluster's head, or ``auto`` for one on this machine; None starts one on this
            machine, for this process only.
        workers: number of tasks at a time on a cluster that is started here; an existing cluster has its own number.
        cores: number of threads of each task.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: Ray is too old, there is no token for the cluster, or the cluster cannot be joined.
    """

    def __init__(self, address: str | None = None, workers: int = 1, cores: int = 1) -> None:
        self._cores = cores
        _protect(begins_one=address is None)
        self._ray = _imported()
        self._folder = tempfile.TemporaryDirectory(prefix="structgstream-ray-", ignore_cleanup_errors=True)
        try:
            _join(self._ray, address, workers * cores, Path(self._folder.name))
        except ConfigError:
            self._folder.cleanup()
            raise
        self._remote = self._ray.remote(run_task)
        self._pending: dict[Any, tuple[str, float]] = {}
        self._counted = (-COUNT_SECONDS, 0)

    def check(self, gpus: int) -> None:
        """See ``Engine.check``; the cluster may get GPUs later."""

    def has_room(self, gpus: int) -> bool:
        return len(self._pending) < IN_FLIGHT * max(1, self.workers())

    def workers(self) -> int:
        """Number of tasks that the machines of the cluster can run at a time; asks now and then."""
        if time.monotonic() - self._counted[0] > COUNT_SECONDS:
            self._counted = (time.monotonic(), int(self._ray.cluster_resources().get("CPU", 0)) // self._cores)
        return self._counted[1]

    def start(self, task: Task, *, gpus: int) -> None:
        options = self._remote.options(
            name=task.name,
            num_cpus=self._cores,
            num_gpus=gpus,
            max_retries=0,  # The queue restarts killed tasks.
            scheduling_strategy="SPREAD",  # Otherwise one machine gets all tasks while others start their workers.
        )
        # Another machine cannot write its output to a file of this machine.
        sent = replace(task, log=None)
        environment = thread_environment(self._cores)
        self._pending[options.remote(sent, environment)] = (task.name, time.monotonic())

    def ended(self, seconds: float) -> list[TaskResult]:
        ready, _ = self._ray.wait(list(self._pending), num_returns=1, timeout=seconds)
        return [self._ending(reference) for reference in ready]

    def _ending(self, reference: Any) -> TaskResult:
        name, begun = self._pending.pop(reference)
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            reason = str(getattr(error, "cause", None) or error)
            raised = isinstance(error, self._ray.exceptions.RayTaskError)  # by our code there; else it was killed
            return TaskResult(name, 1 if raised else -1, time.monotonic() - begun, output=reason)

    def stop(self) -> None:
        """See ``Engine.stop``; a cluster that was joined continues without this process."""
        for reference in self._pending:
            self._ray.cancel(reference)
        if self._pending:
            self._ray.wait(list(self._pending), num_returns=len(self._pending), timeout=10.0)
        self._pending.clear()
        self._ray.shutdown()
        self._folder.cleanup()


def _protect(*, begins_one: bool) -> None:
    """Enables token authentication and disables usage statistics; must be called before Ray is imported."""
    mode = os.environ.setdefault("RAY_AUTH_MODE", "token")
    if mode != "token":  # Ray takes what it does not know as disabled.
        raise ConfigError(
            f"RAY_AUTH_MODE is {mode!r}, and without 'token' anybody who reaches the cluster's ports could run code on "
            "its machines; start the cluster with RAY_AUTH_MODE=token, and set the same here (docs/cluster.md)."
        )
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    given = "RAY_AUTH_TOKEN" in os.environ or "RAY_AUTH_TOKEN_PATH" in os.environ
    if given or (Path.home() / TOKEN_FILE).is_file():
        return
    if not begins_one:
        raise ConfigError(
            f"There is no token for the Ray cluster: neither RAY_AUTH_TOKEN, RAY_AUTH_TOKEN_PATH nor ~/{TOKEN_FILE}; "
            "copy the one that its head was started with (docs/cluster.md)."
        )
    os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)  # Nobody else must join it.


def _imported() -> Any:
    ray = import_extra("ray", "cluster")
    if tuple(int(part) for part in ray.__version__.split(".")[:2]) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise ConfigError(f"Ray {ray.__version__} has no token authentication; {oldest} is the first that has.")
    return ray


def _join(ray: Any, address: str | None, cores: int, folder: Path) -> None:
    """Joins the cluster, or starts one of so many cores."""
    given: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        given |= {"num_cpus": cores, "include_dashboard": False}
        given |= {"object_store_memory": OBJECT_STORE_BYTES, "_temp_dir": str(folder)}
    else:
        given["address"] = address
    try:
        ray.init(**given)
    except Exception as error:  # Ray raises its own errors, RuntimeError and ConnectionError for the same reasons.
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        if address is None:
            raise ConfigError(
                f"A Ray cluster cannot be started here ({reason}); try again when the machine is less busy."
            ) from error
        raise ConfigError(
            f"The Ray cluster at {address} cannot be joined ({reason}); is its head running, and is the token "
            "the one that it was started with?"
        ) from error


POLL_SECONDS = 1.0


def run_task(task: Task, environment: Mapping[str, str]) -> TaskResult:
    """Runs the command in a process of this machine, which is killed when this process ends."""
    process = CommandProcess(task, environment=environment)
    try:
        # Ray cancels a task by raising an exception between two Python instructions, so a wait must be short.
        while not waited_for([process], POLL_SECONDS):
            pass
    except BaseException:
        process.stop()
        raise
    result = process.ended()
    assert result is not None, "the process has ended"
    return result
