"""Workers of a scheduler, and their tasks.

Each worker has at most two tasks, assigned to the worker by name: the current task and the next, without a gap between
them. So the tasks of a lost worker are known, and are reassigned. Dask's own scheduling has longer queues, and
would assign tasks to refused workers.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any, Protocol
from uuid import uuid4

import distributed
import mitsuba as mi

from . import worker
from .compatibility import identity, judge
from .scene_travel import FilesMissing, read

TASKS_PER_WORKER = 2
MOST_LOSSES = 3  # of workers by a single task, which then fails
LOOK_SECONDS = 0.5  # between updates of the list of workers
PATIENCE = 60.0  # seconds without workers or scheduler, after which the render ends


class ClusterError(Exception):
    """The render cannot continue, for the reason in the message."""


class TaskSource(Protocol):
    """Source of tasks. Its methods return a `Task` for a worker with `queued` tasks, or None; take the result of a
    task; and take the ClusterError of a failed task."""

    def next_task(self, queued: int) -> Task | None: ...

    def done(self, name: int | str | None, result: Any, address: str) -> None: ...

    def failed(self, name: int | str | None, error: ClusterError) -> None: ...


@dataclass(eq=False)
class Task:
    """Call of a `function` of worker.py with `arguments`, the first of which is the `SceneBundle`; `name` identifies
    the task to its `source`."""

    source: TaskSource
    name: int | str | None
    function: Callable[..., Any]
    arguments: tuple
    losses: int = 0
    sent: set = field(default_factory=set)  # (address, hash) of transferred files


@dataclass(eq=False)
class _Run:
    """A task on a worker, with its future."""

    task: Task
    address: str
    future: distributed.Future


class Pool:
    """Workers of a scheduler, and the `sources` of their tasks (`TaskSource`), with priority to the first.

    `connect` returns a `distributed.Client`, and is called again after a restart of the scheduler. For use by a single
    thread.
    """

    def __init__(self, connect, threads=None):
        self._connect, self._threads, self._own = connect, threads, identity()
        self._client, self.sources, self.workers = connect(), [], {}
        self._refused, self._again, self._events = {}, [], SimpleQueue()
        self._name, self._numbers = uuid4().hex[:8], itertools.count()
        self._looked = self._seen = -float("inf")
        self._began = time.monotonic()
        mi.Log(mi.LogLevel.Info, f"Dask's dashboard: {self._client.dashboard_link}")
        try:
            self._look()
        except BaseException:
            self.close()
            raise

    def wait(self, seconds):
        """Assign tasks to workers, and wait for a result, up to `seconds`. Raises ClusterError after a minute without
        workers or scheduler."""
        if time.monotonic() - self._looked > max(LOOK_SECONDS, len(self.workers) / 100):
            self._look()
        self._give()
        ended = []
        with suppress(Empty):
            ended.append(self._events.get(timeout=seconds))
            while True:
                ended.append(self._events.get_nowait())
        self._finish([run for run in ended if self._is_ours(run)])

    def forget(self, source):
        """Drop a source and its tasks. The result of a running task is ignored."""
        if source in self.sources:
            self.sources.remove(source)
        self._again = [task for task in self._again if task.source is not source]
        for runs in self.workers.values():
            for run in [run for run in runs if run.task.source is source]:
                runs.remove(run)
                run.future.cancel()

    def close(self):
        """Cancel all tasks, and disconnect from the scheduler."""
        for runs in self.workers.values():
            for run in runs:
                with suppress(Exception):  # the scheduler may be gone
                    run.future.cancel()
        self._client.close(timeout=2)

    # --- Workers that come and go ---

    def _look(self):
        """Update the list of workers."""
        try:
            present = self._client.nthreads()
            self._drop([address for address in self.workers if address not in present])
            self._refused = {address: why for address, why in self._refused.items() if address in present}
            self._take([one for one in present if one not in self.workers and one not in self._refused])
        except (OSError, TimeoutError, RuntimeError) as error:
            self._reconnect(error)
        self._looked = time.monotonic()
        if self.workers:
            self._seen = self._looked
        elif self._looked - max(self._seen, self._began) > PATIENCE:
            refused = "".join(f"; {address} is refused: {why}" for address, why in self._refused.items())
            raise ClusterError(f"the scheduler {self._client.scheduler.address} has no workers{refused}")

    def _take(self, addresses):
        """Admit workers that are compatible."""
        found = self._client.run(worker.begin, self._threads, workers=addresses, on_error="return") if addresses else {}
        for address, other in found.items():
            if isinstance(other, OSError):  # the worker is just gone, or not reachable yet
                continue
            refused, noted = (str(other), None) if isinstance(other, Exception) else judge(self._own, other)
            if refused:
                self._refused[address] = refused
                mi.Log(mi.LogLevel.Warn, f"The worker {address} is refused: {refused}.")
                continue
            if noted:
                mi.Log(mi.LogLevel.Warn, f"The worker {address} has {noted}: images may differ by rounding.")
            self.workers[address] = []
        if self._refused and not self.workers and len(self._refused) == len(found):
            raise ClusterError(f"no worker may take part: {next(iter(self._refused.values()))}")

    def _drop(self, addresses):
        """Remove lost workers, and reassign the tasks of each."""
        for address in addresses:
            mi.Log(mi.LogLevel.Warn, f"The worker {address} is gone; others get its passes.")
            for run in self.workers.pop(address):
                self._lose(run)

    def _lose(self, run):
        """Reassign a task of a lost worker, or let it fail after several losses."""
        task = run.task
        run.future.cancel()
        task.losses += 1
        if task.losses < MOST_LOSSES:
            self._again.append(task)
        else:
            said = f"{MOST_LOSSES} workers were lost with a task: it may need more memory than they have"
            task.source.failed(task.name, ClusterError(said))

    def _reconnect(self, error):
        """Wait for a scheduler that does not answer, and reassign all tasks."""
        mi.Log(mi.LogLevel.Warn, f"The scheduler is gone ({error}); waiting for it.")
        for runs in self.workers.values():
            self._again += [run.task for run in runs]
        self.workers, self._refused = {}, {}
        with suppress(Exception):
            self._client.close(timeout=1)
        end = time.monotonic() + PATIENCE
        while True:
            try:
                self._client = self._connect()
                self._began = time.monotonic()
                return
            except OSError as still:
                if time.monotonic() > end:
                    raise ClusterError(f"the scheduler is gone: {still}") from None
                time.sleep(LOOK_SECONDS)

    # --- Tasks ---

    def _give(self):
        """Assign a task to each worker without any, and then a second one to each."""
        for queued in range(TASKS_PER_WORKER):
            for address, runs in self.workers.items():
                if len(runs) == queued and (task := self._next(queued)):
                    self._submit(task, address)

    def _next(self, queued):
        if self._again:
            return self._again.pop(0)
        return next(filter(None, (source.next_task(queued) for source in self.sources)), None)

    def _submit(self, task, address):
        key = f"{task.function.__name__}-{self._name}-{next(self._numbers)}"
        future = self._client.submit(task.function, *task.arguments, key=key, workers=[address], pure=False)
        run = _Run(task, address, future)
        self.workers[address].append(run)
        future.add_done_callback(lambda _: self._events.put(run))

    def _finish(self, runs):
        """Handle futures that are finished, failed, cancelled or lost."""
        results = self._gather([run for run in runs if run.future.status == "finished"])
        runs = [run for run in runs if self._is_ours(run)]
        for run in runs:
            self.workers[run.address].remove(run)
        self._give()  # first, as sources take time for results
        for run in runs:
            if run in results:
                run.task.source.done(run.task.name, results[run], run.address)
            else:
                self._fail(run, run.future.exception(timeout=PATIENCE) if run.future.status == "error" else None)

    def _gather(self, runs):
        """Return the results of finished runs, except results that were lost with their worker. The workers send them
        directly and at the same time, as each request takes milliseconds."""
        if not runs:
            return {}
        coroutine = self._client.gather([run.future for run in runs], direct=True, asynchronous=True)
        gathering = asyncio.run_coroutine_threadsafe(coroutine, self._client.loop.asyncio_loop)
        while all(map(self._is_ours, runs)):
            try:
                return dict(zip(runs, gathering.result(timeout=LOOK_SECONDS), strict=True))
            except TimeoutError:
                self._look()  # a lost worker sends no result
            except (Exception, asyncio.CancelledError):
                break
        gathering.cancel()
        if len(runs) == 1:
            return {}
        return {run: result for one in runs for run, result in self._gather([one]).items()}

    def _is_ours(self, run):
        """Return whether a run is still assigned to a present worker."""
        return run in self.workers.get(run.address, [])

    def _fail(self, run, error):
        """Handle a run without a result: because of an error, or, if `error` is None, as it is lost."""
        if isinstance(error, FilesMissing):
            self._send(run, error.args[0])
        elif isinstance(error, worker.Interrupted | None) or type(error).__module__.startswith("distributed."):
            self._lose(run)
        else:
            run.task.source.failed(run.task.name, ClusterError(f"{run.address}: {error}"))

    def _send(self, run, hashes):
        """Send missing files to a worker, in sequence, and repeat the task."""
        bundle, task = run.task.arguments[0], run.task
        try:
            if any((run.address, hash) in task.sent for hash in hashes):
                raise ClusterError("files that were sent are not there")
            for hash in hashes:
                self._client.run(worker.add_file, hash, read(bundle, hash), workers=[run.address])
                task.sent.add((run.address, hash))
        except Exception as error:
            task.source.failed(task.name, ClusterError(f"{run.address}: {error}"))
        else:
            self._submit(task, run.address)
