"""Execution of tasks on a Ray cluster."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")


class RayCluster:
    """Context manager that joins a Ray cluster; its machines need this package and access to the tasks' files.

    Args:
        address: ``"auto"``, the address of a running cluster, or ``"local"`` for a temporary one on this machine.
        cpus: cores per task.

    Raises:
        ConnectionError: on entry, if there is no cluster at the address.
    """

    def __init__(self, address: str, *, cpus: int = 1) -> None:
        try:
            import ray
        except ImportError as error:
            raise ImportError(f"ray={address} needs Ray: pip install ray, or torchrl_gn's extra [ray].") from error
        self._ray: Any = ray
        self.address, self.cpus = address, cpus
        self._submitted: list[Any] = []

    def __enter__(self) -> RayCluster:
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # silences a deprecation warning
        options: dict[str, Any] = {"address": self.address}
        if self.address == "local":
            options = {"address": None, "include_dashboard": False}
            # Ray lowers its workers' priority by default, but this process only waits for them.
            os.environ.setdefault("RAY_worker_niceness", "0")
        self._ray.init(log_to_driver=False, logging_level="ERROR", **options)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._ray.shutdown()

    @property
    def size(self) -> int:
        """Number of tasks that run at a time."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)) // self.cpus)

    def imap(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Map a function over items on the cluster; yield results in order."""
        shared, pending = self._ray.put(function), deque()
        task = self._ray.remote(num_cpus=self.cpus)(_call)
        limit = 2 * self.size  # bounds the memory of waiting results
        for item in items:
            if len(pending) >= limit:
                yield self._ray.get(pending.popleft())
            pending.append(task.remote(shared, item))
        while pending:
            yield self._ray.get(pending.popleft())

    def submit(self, function: Callable[..., R], *arguments: Any) -> Future[R]:
        """Run ``function(*arguments)`` on the cluster, without retries."""
        task = self._ray.remote(num_cpus=self.cpus, max_retries=0)(_call).remote(function, *arguments)
        self._submitted.append(task)
        return task.future()

    def stop(self) -> None:
        """Interrupt submitted tasks, as Ctrl-C would, and wait for their end."""
        for task in self._submitted:
            self._ray.cancel(task)
        if self._submitted:
            self._ray.wait(self._submitted, num_returns=len(self._submitted))
        self._submitted.clear()


def _call(function: Callable[..., R], *arguments: Any) -> R:
    """Call a callable object: Ray accepts only functions and classes."""
    return function(*arguments)
