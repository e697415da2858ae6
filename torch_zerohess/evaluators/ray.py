"""Evaluation on a cluster: actors of Ray that hold the black box."""

import functools
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer
from torch_zerohess.evaluators import transfer
from torch_zerohess.evaluators.ahead import Ahead
from torch_zerohess.evaluators.batch import Batch, Chunk
from torch_zerohess.evaluators.default_dtype import default_dtype, take_default_dtype
from torch_zerohess.evaluators.executor import values_of
from torch_zerohess.evaluators.job import Job
from torch_zerohess.evaluators.kept import make_room, used
from torch_zerohess.evaluators.payload import dumped_error, loaded_error
from torch_zerohess.evaluators.process_identity import become_worker
from torch_zerohess.evaluators.random_numbers import Apart

_LOOK = 0.05
"""Seconds after which a wait looks for calls that were submitted meanwhile."""


class Ray(Ahead):
    """Calls the black box in actors of Ray, on one machine or many, one chunk per actor and call.

    An actor keeps the black box from call to call, up to four of them, those that were used last. An actor that
    ends, with its process or its machine, is replaced by a new one, which makes the black box again. Its points are
    tried again, by the new one or by another. What becomes of points that failed too often: see `ProcessPool`. An
    exception of the black box is raised here, also SystemExit. Random numbers: see `ProcessPool`.

    An actor that cannot start, as on a machine without this package, is tried again as often as points are, and then
    given up with a warning. A call without any actor left raises RuntimeError; the next call tries all of them again.
    An actor for which the cluster has no room is waited for.

    A program that has called `ray.init(...)` has chosen its cluster. Otherwise the address in the environment variable
    RAY_ADDRESS is used, and without one a Ray of this machine alone, which ends with `close()`.

    Ray listens on the addresses of its machines, also a Ray of one machine, and runs any code of whoever may connect:
    it belongs in a network of its own, or behind its token authentication. `ProcessPool` listens nowhere.

    Args:
        actors: number of actors; as many as the cluster has cores if None.
        retries: further tries of a chunk, and then of its points, after one that failed; also of the start of an actor.
        **options: of the actors, such as `num_cpus=1`, `num_gpus=0.5`, `resources={"render": 1}`, `runtime_env`, see
            `ray.actor.ActorClass.options`.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ValueError: an argument is out of range.
    """

    def __init__(self, actors: int | None = None, *, retries: int = 2, **options: Any) -> None:
        if actors is not None:
            actors = checked_integer("actors", actors, 1)
        retries = checked_integer("retries", retries, 0)
        try:
            import ray
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("ray is not installed; pip install ray", name="ray") from error
        self._ray: Any = ray
        self.count, self.retries = actors, retries
        self.options = {"num_cpus": 1, "max_restarts": 0, "max_task_retries": 0} | options
        self.actors: list[Any] = []
        """Handles of the actors."""
        self._starting: dict[Any, tuple[Any, int]] = {}
        """Actors that start, by what says that they have, and how many before them could not, one after the other."""
        self._idle: list[Any] = []
        self._busy: dict[Any, tuple[Any, Chunk, Job]] = {}
        """What actors evaluate, by the reference to its values."""
        self._own = False
        self._wanted = 0
        """Number of actors, before any was given up."""
        super().__init__()

    def __repr__(self) -> str:
        return f"Ray(actors={self.count}, retries={self.retries}, options={self.options})"

    @property
    def single_points(self) -> int:
        """Points of a call up to which a chunk has one point: the number of actors, 0 before it is known."""
        return self.count or self._wanted

    def _end(self) -> None:
        for actor in self.actors if self._ray.is_initialized() else ():
            self._ray.kill(actor)
        self.actors, self._idle, self._busy, self._starting, self._functions = [], [], {}, {}, {}
        if self._own:
            self._own = False
            self._ray.shutdown()

    def _sent(self, fn: Callable[..., Any]) -> Any:
        self._connect()
        self._wanted = self.count or max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        return self._ray.put(fn)

    def _batch(self, points: Tensor) -> Batch:
        return Batch(points, self.retries, self._wanted)

    def _round(self, jobs: Sequence[Job]) -> None:
        if not self.actors:
            for _ in range(self._wanted):
                self._start(0)
        for actor in list(self._idle):
            job = next((job for job in jobs if job.waiting), None)
            if job is None:
                break
            if not job.begin():
                continue
            self._idle.remove(actor)
            chunk = job.batch.take()
            data = transfer.packed([one[chunk.start : chunk.stop] for one in job.tensors])
            self._busy[actor.evaluate.remote([job.function.sent], data, default_dtype())] = actor, chunk, job
        done, _ = self._ray.wait([*self._busy, *self._starting], num_returns=1, timeout=_LOOK)
        for one in done:
            if one in self._busy:
                actor, chunk, job = self._busy.pop(one)
                if self._answered(one, chunk, job.batch):
                    self._idle.append(actor)
                else:
                    self._remove(actor)
                    self._start(0)
            else:
                self._started(one)

    def _give_up(self, jobs: Sequence[Job]) -> None:
        for one, (actor, _, job) in list(self._busy.items()):
            if job in jobs:
                self._ray.cancel(one)
                del self._busy[one]
                self._idle.append(actor)

    def _connect(self) -> None:
        if self._ray.is_initialized():
            return
        if os.environ.get("RAY_ADDRESS"):
            self._ray.init()
            return
        here = os.pathsep.join(folder or os.getcwd() for folder in sys.path)  # what can be imported here, can be there
        environment = {"env_vars": {"PYTHONPATH": here}}
        self._ray.init(address="local", include_dashboard=False, num_cpus=self.count, runtime_env=environment)
        self._own = True

    def _answered(self, one: Any, chunk: Chunk, batch: Batch) -> bool:
        """Treat what became of a chunk; False if its actor has ended."""
        errors = self._ray.exceptions
        try:
            good, data = self._ray.get(one)
            if good:
                batch.came(chunk, transfer.unpacked(data)[0])
            else:
                batch.raised(chunk, loaded_error(data))
        except errors.RayTaskError as error:
            batch.raised(chunk, error)
        except errors.RayError as error:
            reason = str(error).strip().splitlines()
            batch.failed(chunk, f"an actor ended ({type(error).__name__}: {reason[0] if reason else ''})")
            return False
        return True

    def _start(self, failures: int) -> None:
        actor = self._ray.remote(Actor).options(**self.options).remote()
        self.actors.append(actor)
        self._starting[actor.ready.options(max_task_retries=0).remote()] = actor, failures

    def _remove(self, actor: Any) -> None:
        self._ray.kill(actor)  # which Ray may be about to restart, if it was told to
        self.actors.remove(actor)

    def _started(self, one: Any) -> None:
        """Let an actor that has started work. Start one in place of an actor that could not, or give it up."""
        actor, failures = self._starting.pop(one)
        try:
            self._ray.get(one)
        except self._ray.exceptions.RayError as error:
            self._remove(actor)
            if failures < self.retries:
                self._start(failures + 1)
                return
            reason = f"{type(error).__name__}: {str(error).strip().splitlines()[-1]}"
            if not self.actors:
                raise RuntimeError(f"no actor of Ray can start: {reason}") from error
            left = f"{len(self.actors)} of {self._wanted} are left"
            warnings.warn(f"an actor of Ray cannot start, {left}: {reason}", RuntimeWarning, stacklevel=2)
        else:
            self._idle.append(actor)


class Actor:
    """What runs on the cluster: it fetches a black box once, and keeps it."""

    def __init__(self) -> None:
        torch.set_num_threads(1)
        become_worker()
        self._kept: dict[Any, tuple[Any, Apart]] = {}
        """Black boxes, and their calls, by their references."""

    def ready(self) -> None:
        """Do nothing, once the actor has started."""

    def evaluate(self, held: list[Any], data: bytes, dtype: str) -> tuple[bool, bytes]:
        """Return True and the values of a chunk, or False and the error of the black box.

        A reference inside a list is not fetched with every call.
        """
        import ray

        try:
            take_default_dtype(dtype)
            if held[0] not in self._kept:
                make_room(self._kept)
                fn = ray.get(held[0])
                self._kept[held[0]] = fn, Apart(fn)
            fn, apart = used(self._kept, held[0])
            return True, apart.call(functools.partial(values_of, fn, data))
        except BaseException as error:  # SystemExit too: Ray would end the actor
            if hasattr(error, "ray_terminate_msg"):  # Ray itself ends the actor
                raise
            return False, dumped_error(error, traceback.format_exc(), ray.cloudpickle.dumps)
