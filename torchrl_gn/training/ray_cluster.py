"""Work spread over the machines of a Ray cluster."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")


class RayCluster:
    """A Ray cluster, as a context: joined on entry and left on exit.

    All machines need this package, and see the same files where work writes any.

    Args:
        address: ``"auto"`` or the address of a running cluster, or ``"local"``: one that lasts as long as the block, on
            this machine.
        cpus: cores that every piece of work takes.

    Raises:
        ImportError: if Ray is not installed.
        ConnectionError: on entry, if there is no cluster at the address.
    """

    def __init__(self, address: str, *, cpus: int = 1) -> None:
        try:
            import ray
        except ImportError as error:
            raise ImportError(f"ray={address} needs Ray: pip install ray, or torchrl_gn's extra [ray].") from error
        self._ray: Any = ray
        self.address, self.cpus = address, cpus
        self._started: list[Any] = []

    def __enter__(self) -> RayCluster:
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or it warns of a change to come
        where: dict[str, Any] = {"address": self.address}
        if self.address == "local":
            where = {"address": None, "include_dashboard": False}
            # Ray's workers give way to all else; but this process only waits for them.
            os.environ.setdefault("RAY_worker_niceness", "0")
        self._ray.init(log_to_driver=False, logging_level="ERROR", **where)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._ray.shutdown()

    @property
    def size(self) -> int:
        """Pieces of work that the cluster does at a time."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)) // self.cpus)

    def imap(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Like the built-in ``map``, on the whole cluster: results come in the order of the items."""
        shared, pending = self._ray.put(function), deque()
        task = self._ray.remote(num_cpus=self.cpus)(_call)
        limit = 2 * self.size  # so that results that nobody took yet do not fill the memory
        for item in items:
            if len(pending) >= limit:
                yield self._ray.get(pending.popleft())
            pending.append(task.remote(shared, item))
        while pending:
            yield self._ray.get(pending.popleft())

    def submit(self, function: Callable[..., R], *arguments: Any) -> Future[R]:
        """Begin ``function(*arguments)`` somewhere; once, whatever happens."""
        started = self._ray.remote(num_cpus=self.cpus, max_retries=0)(_call).remote(function, *arguments)
        self._started.append(started)
        return started.future()

    def stop(self) -> None:
        """Interrupt what was submitted, as Ctrl-C would, and wait until it has ended."""
        for started in self._started:
            self._ray.cancel(started)
        if self._started:
            self._ray.wait(self._started, num_returns=len(self._started))
        self._started.clear()


def _call(function: Callable[..., R], *arguments: Any) -> R:
    """Ray takes only what is written as a function or class."""
    return function(*arguments)
