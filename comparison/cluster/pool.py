"""The workers of a scheduler, and which tasks they have.

Tasks are given to workers by name, never more than two to each: one that it works on, and one that it goes on with
without waiting for us. So it is known which tasks a worker that dies takes with it: they are given to others. Dask's
own distribution would neither hold its queues that short nor keep tasks from workers that are refused.
"""

import asyncio
import itertools
import time
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from uuid import uuid4

import mitsuba as mi

from . import worker
from .compatibility import identity, judge
from .scene_travel import FilesMissing, read

TASKS_PER_WORKER = 2
MOST_LOSSES = 3  # of one task: whoever ends as many workers is not tried again
LOOK_SECONDS = 0.5  # from one look at which workers there are to the next
PATIENCE = 60.0  # seconds without a single worker, or without the scheduler, after which the render ends


class ClusterError(Exception):
    """The render cannot go on; its message says why."""


@dataclass(eq=False)
class Task:
    """A call of a `function` of worker.py with `arguments`, of which the first is the `SceneBundle`; `name` is what its
    `source` knows it by."""

    source: object
    name: object
    function: object
    arguments: tuple
    losses: int = 0
    sent: set = field(default_factory=set)  # (address, hash) of files that were sent for it


@dataclass(eq=False)
class _Run:
    """A task on a worker, a future of Dask's."""

    task: Task
    address: str
    future: object


class Pool:
    """The workers of a scheduler, and the sources of their tasks.

    `connect` returns a `distributed.Client`, also when the scheduler was started anew. A source has `next_task(queued)`
    that returns a `Task` for a worker which has so many, or None; `done(name, result, address)`; and `failed(name,
    error)` for a ClusterError. Sources are asked in their order: later ones have what earlier ones leave. For one
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
        """Give tasks to workers, and wait for a result, up to some seconds. Raises ClusterError where there are no
        workers, or no scheduler, for a minute."""
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
        """Drop a source, and the tasks that workers have of it. One that is being worked on goes on, for nothing."""
        if source in self.sources:
            self.sources.remove(source)
        self._again = [task for task in self._again if task.source is not source]
        for runs in self.workers.values():
            for run in [run for run in runs if run.task.source is source]:
                runs.remove(run)
                run.future.cancel()

    def close(self):
        """Let go of all tasks and of the scheduler."""
        for runs in self.workers.values():
            for run in runs:
                with suppress(Exception):  # of a scheduler that is gone
                    run.future.cancel()
        self._client.close(timeout=2)

    # --- Workers that come and go ---

    def _look(self):
        """See which workers there are."""
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
        """Let workers take part, if they are compatible."""
        found = self._client.run(worker.begin, self._threads, workers=addresses, on_error="return") if addresses else {}
        for address, other in found.items():
            if isinstance(other, OSError):  # it has just gone, or is not reached yet
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
        """Workers are gone; others get their tasks."""
        for address in addresses:
            mi.Log(mi.LogLevel.Warn, f"The worker {address} is gone; others get its passes.")
            for run in self.workers.pop(address):
                self._lose(run)

    def _lose(self, run):
        """A task has gone with its worker."""
        task = run.task
        run.future.cancel()
        task.losses += 1
        if task.losses < MOST_LOSSES:
            self._again.append(task)
        else:
            said = f"{MOST_LOSSES} workers were lost with a task: it may need more memory than they have"
            task.source.failed(task.name, ClusterError(said))

    def _reconnect(self, error):
        """The scheduler does not answer: wait for it to come back, and give out all tasks anew."""
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
        """Give each worker a task that has none, and then one more."""
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
        """Futures have come to their end, if only because they were cancelled, or lost with their workers."""
        results = self._gather([run for run in runs if run.future.status == "finished"])
        runs = [run for run in runs if self._is_ours(run)]
        for run in runs:
            self.workers[run.address].remove(run)
        self._give()  # first: what sources do with results takes time
        for run in runs:
            if run in results:
                run.task.source.done(run.task.name, results[run], run.address)
            else:
                self._fail(run, run.future.exception(timeout=PATIENCE) if run.future.status == "error" else None)

    def _gather(self, runs):
        """Return the results of finished runs, but for those whose worker is lost before it hands them over. They come
        directly from the workers, all at once: each way takes milliseconds."""
        if not runs:
            return {}
        coroutine = self._client.gather([run.future for run in runs], direct=True, asynchronous=True)
        gathering = asyncio.run_coroutine_threadsafe(coroutine, self._client.loop.asyncio_loop)
        while all(map(self._is_ours, runs)):
            try:
                return dict(zip(runs, gathering.result(timeout=LOOK_SECONDS), strict=True))
            except TimeoutError:
                self._look()  # what a worker that is gone has not handed over is waited for in vain
            except (Exception, asyncio.CancelledError):
                break
        gathering.cancel()
        if len(runs) == 1:
            return {}
        return {run: result for one in runs for run, result in self._gather([one]).items()}

    def _is_ours(self, run):
        """Is a worker, which is there, still to have a run?"""
        return run in self.workers.get(run.address, [])

    def _fail(self, run, error):
        """A run has no result: because of an error, or, if that is None, as it is lost."""
        if isinstance(error, FilesMissing):
            self._send(run, error.args[0])
        elif isinstance(error, worker.Interrupted | None) or type(error).__module__.startswith("distributed."):
            self._lose(run)
        else:
            run.task.source.failed(run.task.name, ClusterError(f"{run.address}: {error}"))

    def _send(self, run, hashes):
        """Send a worker the files that it lacks, one by one, and let it try again."""
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
