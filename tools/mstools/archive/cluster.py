"""Tasks on a Dask cluster: one on this machine, or one that runs already, by the address of its scheduler.

A scheduler gets `AHEAD` tasks a worker, however many there are: it holds some 10 kB for each, and passes 10^4 tasks
without strain and 10^6 not at all. A task whose worker ends is run again by another one; after three workers have ended
under it (Dask's `allowed-failures`) its outcome is an error.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import resource_tracker
from queue import Queue
from typing import TYPE_CHECKING, Any, Final, TypeVar

from modelserver.errors import ModelServerError, quote
from modelserver.server.journal.writer import collect_facts
from mstools.terminal.output import require_extra

if TYPE_CHECKING:
    from distributed import Client, Future

AHEAD: Final = 4
"""Tasks handed out for each worker: one runs, and the next ones are there before it ends."""

CONNECT_S: Final = 10.0
"""Seconds within which a scheduler must answer."""

Given = TypeVar("Given")
Outcome = TypeVar("Outcome")


@dataclass(frozen=True)
class Cluster:
    """A running cluster. `dashboard` is the address of its page, empty without one."""

    client: Client
    dashboard: str

    def run(
        self, function: Callable[[Given], Outcome], tasks: Iterable[Given]
    ) -> Iterator[tuple[Given, Outcome | ModelServerError]]:
        """Yield each task with its outcome as they end; an error where all workers that had it ended.

        What the function raises is raised. Raises ModelServerError where the scheduler ends.
        """
        from distributed import KilledWorker

        waiting: dict[Future, Given] = {}
        done: Queue[Future] = Queue()
        remaining = iter(tasks)

        def submit_next() -> None:
            free = max(self._count_workers(), 1) * AHEAD - len(waiting)
            for task in islice(remaining, max(free, 0)):
                # not by its content: the same task may be run twice
                future = self.client.submit(function, task, pure=False)
                waiting[future] = task
                future.add_done_callback(done.put)

        try:
            submit_next()
            while waiting:
                future = done.get()
                task = waiting.pop(future)
                submit_next()
                if future.status not in ("finished", "error"):
                    raise ModelServerError("the scheduler ended, or dropped tasks: start it and run again")
                try:
                    yield task, future.result()
                except KilledWorker as error:
                    workers = error.allowed_failures + 1
                    yield task, ModelServerError(f"{workers} workers ended while they ran it: see their logs, memory")
        finally:
            self.client.cancel(list(waiting), force=True)

    def _count_workers(self) -> int:
        return len(self.client.scheduler_info(n_workers=-1)["workers"])


@contextmanager
def open_cluster(scheduler: str = "", workers: int = 0) -> Iterator[Cluster]:
    """Connect to a scheduler (`tcp://HOST:PORT`), else start a cluster on this machine for the block.

    `workers`: processes on this machine, 0 for one per core. Raises ModelServerError where the extra is not installed,
    the scheduler does not answer, or a worker of it has another version of the source.
    """
    require_extra("archive", "work on a cluster needs Dask")
    import dask
    from distributed import Client, LocalCluster

    with block_interrupt():
        if scheduler:
            try:
                client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
            except (OSError, ValueError, TypeError) as error:
                raise ModelServerError(
                    f"no scheduler answers at {quote(scheduler)} ({error}); start one with: dask scheduler, and "
                    "workers with: dask worker ADDRESS --nthreads 1"
                ) from None
            cluster = None
        else:
            # a worker holds the profiles of an hour's seconds: 1 GB
            with dask.config.set({"distributed.worker.profile.enabled": False}):
                cluster = LocalCluster(
                    n_workers=workers or os.cpu_count() or 1,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    memory_limit=0,  # a task's memory is bounded, and pages of a mapped log would count
                    silence_logs=logging.CRITICAL,  # a worker that ends is seen by its task
                )
            client = Client(cluster, set_as_default=False)
    try:
        if scheduler:
            _check_versions(client)
        yield Cluster(client, client.dashboard_link or "")
    finally:
        with block_interrupt():
            client.close()
            if cluster is not None:
                cluster.close()


def _check_versions(client: Client) -> None:
    found: dict[str, Any] = client.run(hash_code)
    if others := sorted(address for address, code in found.items() if code != hash_code()):
        raise ModelServerError(
            f"{len(others)} of {len(found)} workers have another version of ModelServer or its libraries than this "
            f"machine, first {others[0]}: install the same one on all of them"
        )


def hash_code() -> str:
    """Return what identifies the code that computes: source, Python, and the libraries that affect last bits."""
    facts = collect_facts()
    return " ".join(facts[name] for name in ("source", "python", "numpy", "filterpy", "pyproj"))


@contextmanager
def block_interrupt() -> Iterator[None]:
    """Block SIGINT, which is delivered afterwards: processes that start within inherit that, and keep it.

    Ctrl-C reaches all processes of a terminal: so it ends only this one, which ends them.
    """
    # it unblocks the signal in the thread that starts it
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
