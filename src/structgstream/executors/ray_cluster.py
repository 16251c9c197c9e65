# SPDX-License-Identifier: Apache-2.0
"""The engine ``ray``: tasks on the machines of a Ray cluster, or on one that is begun on this machine.

Note [Ray's ports]: whoever reaches a cluster's ports and is let in runs any code on all of its machines. So a cluster
is only joined, or begun, with token authentication, which Ray has from 2.52 on and leaves off by default.
"""

import os
import secrets
import tempfile
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from structgstream.errors import ConfigError, MissingExtraError
from structgstream.executors.places import thread_environment
from structgstream.executors.ray_worker import CommandKilled, run_task
from structgstream.executors.task import Ending, Task

OLDEST = (2, 52)
OBJECT_STORE_BYTES = 80 * 2**20
"""Ray's least: commands and endings are all that travels."""
IN_FLIGHT = 2
"""Tasks handed to Ray for each worker: one runs, and one is there when it ends."""
COUNT_SECONDS = 10.0
"""How old the count of the cluster's workers may be."""
TOKEN_FILE = Path(".ray") / "auth_token"


@dataclass(frozen=True)
class RayOptions:
    """Which cluster, and what a worker is.

    Args:
        address: ``HOST:PORT`` of the cluster's head, or ``auto`` for one on this machine; None begins one here, for
            this process alone, with ``workers``.
        workers: of a cluster that is begun here.
        cores: that a worker has.
    """

    address: str | None = None
    workers: int = 1
    cores: int = 1


class RayEngine:
    """Tasks of a Ray cluster; see :class:`RayOptions`.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: it is too old, there is no token for the cluster, or the cluster cannot be joined.
    """

    name = "ray"
    repeats = True

    def __init__(self, options: RayOptions) -> None:
        self._options = options
        _protect(begins_one=options.address is None)
        self._ray = _imported()
        self._folder = tempfile.TemporaryDirectory(prefix="structgstream-ray-", ignore_cleanup_errors=True)
        try:
            _join(self._ray, options, Path(self._folder.name))
        except ConfigError:
            self._folder.cleanup()
            raise
        self._pending: dict[Any, tuple[str, float]] = {}
        self._counted = (-COUNT_SECONDS, 0)

    @cached_property
    def _remote(self) -> Any:
        return self._ray.remote(run_task)

    def check(self, gpus: int) -> None:
        """See ``Engine.check``; the cluster may get GPUs later."""

    def has_room(self, gpus: int) -> bool:
        """See ``Engine.has_room``."""
        return len(self._pending) < IN_FLIGHT * max(1, self.workers())

    def workers(self) -> int:
        """How many tasks the machines of the cluster can run at a time, now."""
        when, count = self._counted
        if time.monotonic() - when > COUNT_SECONDS:
            count = int(self._ray.cluster_resources().get("CPU", 0)) // self._options.cores
            self._counted = (time.monotonic(), count)
        return count

    def start(self, task: Task, *, gpus: int, attempt: int) -> None:
        """See ``Engine.start``."""
        options = self._remote.options(
            name=task.name,
            num_cpus=self._options.cores,
            num_gpus=gpus,
            max_retries=task.retries,
            retry_exceptions=[CommandKilled],
            scheduling_strategy="SPREAD",  # Else one machine gets tasks after tasks while others begin their workers.
        )
        # A file of this machine is no place for what is printed on another.
        sent = replace(task, log=None)
        environment = thread_environment(self._options.cores)
        self._pending[options.remote(sent, environment)] = (task.name, time.monotonic())

    def ended(self, seconds: float) -> list[Ending]:
        """See ``Engine.ended``."""
        ready, _ = self._ray.wait(list(self._pending), num_returns=1, timeout=seconds)
        return [self._ending(reference) for reference in ready]

    def _ending(self, reference: Any) -> Ending:
        name, begun = self._pending.pop(reference)
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            reason = str(getattr(error, "cause", None) or error)
            return Ending(name, -1, time.monotonic() - begun, output=reason)

    def stop(self) -> None:
        """See ``Engine.stop``; a cluster that was joined goes on without this process."""
        for reference in self._pending:
            self._ray.cancel(reference)
        if self._pending:
            self._ray.wait(list(self._pending), num_returns=len(self._pending), timeout=10.0)
        self._pending.clear()
        self._ray.shutdown()
        self._folder.cleanup()


def _protect(*, begins_one: bool) -> None:
    """Turns on token authentication, and off what Ray tells its makers, before Ray is loaded and reads this.

    Raises:
        ConfigError: authentication is turned off, or there is no token for the cluster to join.
    """
    mode = os.environ.setdefault("RAY_AUTH_MODE", "token")
    if mode == "disabled":
        raise ConfigError(
            "RAY_AUTH_MODE is 'disabled', so that anybody who reaches the cluster's ports could run code on its "
            "machines; begin the cluster with RAY_AUTH_MODE=token, and set the same here (docs/cluster.md)."
        )
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    given = "RAY_AUTH_TOKEN" in os.environ or "RAY_AUTH_TOKEN_PATH" in os.environ
    if mode != "token" or given or (Path.home() / TOKEN_FILE).is_file():
        return
    if not begins_one:
        raise ConfigError(
            f"There is no token for the Ray cluster: neither RAY_AUTH_TOKEN, RAY_AUTH_TOKEN_PATH nor ~/{TOKEN_FILE}; "
            "copy the one that its head was begun with (docs/cluster.md)."
        )
    os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)  # Nobody else is to join it.


def _imported() -> Any:
    try:
        import ray  # pyright: ignore[reportMissingImports] -- an extra that tests do without
    except ModuleNotFoundError:
        raise MissingExtraError("ray", "cluster") from None
    if tuple(int(part) for part in ray.__version__.split(".")[:2]) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise ConfigError(f"Ray {ray.__version__} has no token authentication; {oldest} is the first that has.")
    return ray


def _join(ray: Any, options: RayOptions, folder: Path) -> None:
    """Joins the cluster, or begins one.

    Raises:
        ConfigError: it is not reached, refuses the token, or does not begin.
    """
    given: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if options.address is None:
        given |= {"num_cpus": options.workers * options.cores, "include_dashboard": False}
        given |= {"object_store_memory": OBJECT_STORE_BYTES, "_temp_dir": str(folder)}
    else:
        given["address"] = options.address
    try:
        ray.init(**given)
    except Exception as error:  # Ray has its own, RuntimeError and ConnectionError for what all means one thing.
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        if options.address is None:
            raise ConfigError(
                f"A Ray cluster cannot be begun here ({reason}); try again when the machine does less."
            ) from error
        raise ConfigError(
            f"The Ray cluster at {options.address} cannot be joined ({reason}); is its head running, and is the token "
            "the one that it was begun with?"
        ) from error
