"""An external program as a black box, over its standard input and output."""

import functools
import io
import json
import os
import subprocess
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from torch_zerohess.adapters.command import checked_environment, found_program
from torch_zerohess.adapters.server import GRACE, Server, end_program, ended, late, shown
from torch_zerohess.arguments import check_bool, check_tensors, checked_number
from torch_zerohess.evaluators.batch import numbers
from torch_zerohess.evaluators.evaluator import Closing
from torch_zerohess.evaluators.lifetime import ends_by_its_group
from torch_zerohess.evaluators.partial_values import keep_finished
from torch_zerohess.evaluators.values import as_tensor


class Program(Closing):
    """A program that reads points and writes values: x [K, n], *aux [K, ...] -> [K, *out].

    | command | what runs | input | output |
    |---|---|---|---|
    | list | the program, once per call | all K points | all K values |
    | list, `server=True` | the program, once, until `close()` | a request per call | an answer per request |
    | function | `command(point [n])`, once per point | nothing | one value |

    Formats of input and output:

    - "json": a request is the line `{"x": [[...], ...]}`, with `"aux": [...]` where there is aux. The answer is one
      line, the list of K values. Numbers are written so that float64 is read back exactly.
    - "npy": a request is the array x, then each aux, as `numpy.save` writes them, in the types of the tensors. NumPy
      has no bfloat16: such a tensor is written as float32. The answer is one array of numbers, as
      `numpy.save(sys.stdout.buffer, values)` writes it. `numpy.load` cannot read from a pipe. A Python program reads
      one array by `numpy.lib.format.read_array(types.SimpleNamespace(read=sys.stdin.buffer.read))`.
    - a function of bytes: turns the output into the value, and may skip a banner. Requests are written as for "json".

    A server writes one answer per request and flushes it, and writes messages to the standard error alone. More answers
    are an error of the call if they come with the first one, and of the next call if they are there when it begins. A
    server ends when its standard input does. A server that ended or took too long is started again by the next call.

    A run fails if it ends with a code other than 0, takes too long, or writes no number, or fewer or more of them than
    before. With on_failure="nan" all points of the run have NaN as their values, in the shape of earlier outputs.
    Before the first output the shape is not known, and each point gets a single NaN. Searches, layers and evaluators
    take it for an output without any number. `on_nonfinite` of a layer says how it treats a NaN; `minimize` avoids the
    point.

    A `Program` can be pickled; a copy starts a program of its own. So does a process made by a fork, as the workers of
    a DataLoader are.

    Args:
        command: program and arguments, or a function that returns them for a point. A path of the program is relative
            to `folder`.
        server: whether the program answers many requests.
        format: see above.
        timeout: seconds per point, after which the program ends, with the programs that it started; None: no limit.
        folder: where the program runs; here if None.
        environment: variables added to the environment of this process. A PATH among them finds the program, too.
            Relative folders in it are relative to `folder`.
        on_failure: "raise", or "nan" to go on without the values of a run that fails.

    Raises:
        FileNotFoundError: there is no such program or folder.
        TypeError, ValueError: an argument is wrong; or, from a call, the answer cannot be read.
        TimeoutError, RuntimeError: from a call, the program took too long, or ended with a code other than 0. The
            message has the point, and what the program wrote to the standard error.

    Example:
        >>> import sys
        >>> sums = "import json, sys; print([sum(p) for p in json.loads(sys.stdin.readline())['x']])"
        >>> Program([sys.executable, "-c", sums])(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
        tensor([3., 7.], dtype=torch.float64)
    """

    takes_batches = True

    def __init__(
        self,
        command: Sequence[str] | Callable[[Tensor], Sequence[str]],
        *,
        server: bool = False,
        format: str | Callable[[bytes], Any] = "json",
        timeout: float | None = None,
        folder: str | None = None,
        environment: Mapping[str, str] | None = None,
        on_failure: Literal["raise", "nan"] = "raise",
    ) -> None:
        if isinstance(command, str) or (not callable(command) and not command):
            raise ValueError(f"command must be a list, the program and its arguments, or a function, got {command!r}")
        if format not in ("json", "npy") and not callable(format):
            raise ValueError(f"format must be 'json', 'npy' or a function of bytes, got {format!r}")
        check_bool(server=server)
        if server and (callable(command) or callable(format)):
            raise ValueError("server=True needs a command that is a list, and format 'json' or 'npy'")
        if on_failure not in ("raise", "nan"):
            raise ValueError(f"on_failure must be 'raise' or 'nan', got {on_failure!r}")
        self.command, self.server, self.format = command, server, format
        self.timeout = None if timeout is None else checked_number("timeout", timeout, above=0.0)
        self.on_failure = on_failure
        self._shape: torch.Size | None = None
        """Of the values of a point; None if there are none yet."""
        self.last_failure: str | None = None
        """Message of the last run that failed, with what it wrote to the standard error; in worker processes theirs."""
        self.folder, self.environment = folder, checked_environment(environment)
        if folder is not None and not os.path.isdir(folder):
            raise FileNotFoundError(f"folder must be a folder that exists, got {folder!r}")
        if not callable(command):
            found_program(command, folder, self.environment)
        self._forget()

    def __repr__(self) -> str:
        return f"Program({self.command!r}, server={self.server}, format={self.format!r})"

    def __getstate__(self) -> dict[str, Any]:
        own = ("_server", "_end", "_asked", "_process")
        return {name: one for name, one in vars(self).items() if name not in own}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._forget()

    def _forget(self) -> None:
        """Have no server: at first, in a copy, and after a fork, where the server belongs to the other process."""
        self._server: Server | None = None
        self._end: weakref.finalize[Any, Any] | None = None
        """Ends the server: called by `close`, when nobody refers to this object any more, or when Python ends."""
        self._asked = threading.Lock()
        self._process = os.getpid()

    def close(self) -> None:
        """End the server, if there is one."""
        if self._end is not None:
            self._end()
        self._server = self._end = None

    def __call__(self, x: Tensor, *aux: Tensor) -> Tensor:
        """Evaluate at points [K, n] with auxiliary inputs [K, ...].

        Raises TypeError for what is no tensor, ValueError for a single point [n], or if the program did not print one
        value per point.
        """
        check_tensors(x=x, aux=aux)
        if x.dim() < 2:
            raise ValueError(
                f"x must be points [K, n], got {list(x.shape)}: a Program takes many, leave vectorized=True"
            )
        if len(x) and self.on_failure == "raise":
            self._shape = None  # of this call; where runs may fail, it is also known from earlier ones
        if callable(self.command):
            if aux:
                raise ValueError(f"aux must be empty for a command that is a function of x, got {len(aux)} tensors")
            if not len(x):
                return _missing((0, *(self._shape or ())))
            found: dict[int, Tensor | None] = {}
            try:
                for k, one in enumerate(x.detach()):  # a command may write its point to a file: one after the other
                    command = found_program(self.command(one.clone()), self.folder, self.environment)
                    found[k] = self._unless_failed(functools.partial(self._run, command, b"", 1), one)
            except BaseException as error:  # Ctrl-C, too
                keep_finished(error, x, {k: one for k, one in found.items() if one is not None})
                raise
            return torch.stack([_missing(self._shape or ()) if one is None else one for one in found.values()])
        answer = self._serve if self.server else functools.partial(self._run, self.command)
        values = self._unless_failed(functools.partial(answer, self._request(x, aux), len(x)), x)
        return _missing((*x.shape[:-1], *(self._shape or ()))) if values is None else values

    def _unless_failed(self, run: Callable[[], Tensor], x: Tensor) -> Tensor | None:
        """Return the values of a run at x; None if it fails and that is no error. The message names the first point."""
        try:
            return self._checked(run(), x)
        except (RuntimeError, TimeoutError, ValueError) as error:
            points = x.reshape(-1, x.shape[-1])
            more = f" and {len(points) - 1} more" if len(points) > 1 else ""
            error.args = (f"at the point [{numbers(points[0])}]{more}: {error}",)
            if self.on_failure == "raise":
                raise
            self.last_failure = str(error)
            return None

    def _checked(self, values: Tensor, x: Tensor) -> Tensor:
        """Return the values of a run at x [..., n]; ValueError if they are not [..., *out] as before."""
        batch, shape = x.shape[:-1], values.shape[x.dim() - 1 :]
        if values.shape[: len(batch)] != batch:
            raise ValueError(
                f"the program must write one value per point, a list of {len(x)} for points {list(x.shape)}, got "
                f"{list(values.shape)}"
            )
        if not values.numel() and len(x):
            raise ValueError(f"the program must write numbers, got {list(values.shape)}")
        if self._shape is not None and shape != self._shape:
            before, now = list(self._shape), list(shape)
            raise ValueError(f"the program must write values of one shape, {before} as before, got {now}")
        self._shape = shape
        return values

    def _serve(self, request: bytes, points: int) -> Tensor:
        assert not callable(self.command)
        if self._process != os.getpid():
            self._forget()
        with self._asked:
            if self._server is not None and not self._server.alive:
                self.close()
            if self._server is None:
                process = self._start(self.command)
                try:
                    self._server = Server(process)
                    self._end = weakref.finalize(self, self._server.end)
                except BaseException:  # Ctrl-C
                    end_program(process)
                    raise
            try:
                answer = self._server.ask(request, self.format == "npy", self._limit(points))
                values = self._values(answer, b"".join(self._server.errors))
                self._server.refuse_more("after the answer")
                return values
            except BaseException:  # also Ctrl-C: an answer may be on its way
                self.close()
                raise

    def _limit(self, points: int) -> float | None:
        return None if self.timeout is None else self.timeout * max(1, points)

    def _start(self, command: Sequence[str]) -> "subprocess.Popen[bytes]":
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        variables = None if self.environment is None else os.environ | self.environment
        # A group of its own, to end it with the programs that it starts. In a worker it ends with the group of that.
        own = not ends_by_its_group()
        return subprocess.Popen(list(command), cwd=self.folder, env=variables, start_new_session=own, **pipes)

    def _run(self, command: Sequence[str], request: bytes, points: int) -> Tensor:
        limit = self._limit(points)
        with self._start(command) as process:
            try:
                output, errors = process.communicate(request, limit)
            except subprocess.TimeoutExpired:
                end_program(process)
                try:
                    errors = process.communicate(timeout=GRACE)[1]
                except subprocess.TimeoutExpired as error:  # a program that left the group holds the pipe
                    errors = error.stderr or b""
                raise TimeoutError(late(command, limit, errors)) from None
            except BaseException:  # also Ctrl-C, which a group of its own does not get
                end_program(process)
                process.wait()
                raise
        if process.returncode:
            raise RuntimeError(ended(command, process.returncode, errors))
        return self._values(output, errors)

    def _request(self, x: Tensor, aux: Sequence[Tensor]) -> bytes:
        tensors = [one.detach().cpu() for one in (x, *aux)]
        if self.format == "npy":
            import numpy as np

            file = io.BytesIO()
            for one in tensors:
                np.save(file, (one.float() if one.dtype is torch.bfloat16 else one).numpy())
            return file.getvalue()
        content: dict[str, Any] = {"x": tensors[0].tolist()}
        if aux:
            content["aux"] = [one.tolist() for one in tensors[1:]]
        return (json.dumps(content) + "\n").encode()

    def _values(self, output: bytes, errors: bytes) -> Tensor:
        try:
            if callable(self.format):
                return as_tensor(self.format(output))
            if self.format == "npy":
                import numpy as np

                file = io.BytesIO(output)
                values = as_tensor(np.load(file, allow_pickle=False))
                if more := file.read():
                    raise ValueError(f"it wrote {len(more)} bytes after the array")
                return values
            found = json.loads(output)
            if b"null" in output:
                raise ValueError("it printed null where a number was expected")
            return torch.tensor(found, dtype=torch.float64, device="cpu")
        except Exception as error:  # a function may raise any
            start = output[:200].decode(errors="replace")
            named = "what the function `format` reads" if callable(self.format) else f"values as {self.format}"
            read = self.format == "json" and not isinstance(error, json.JSONDecodeError)
            skip = "" if self.server or callable(self.format) else ", or skip them in a function `format`"
            advice = "" if read else f": let it print messages to its standard error{skip}"
            raise ValueError(
                f"the program must write {named} and nothing else to its standard output, got {start!r} "
                f"({type(error).__name__}: {error}){advice}{shown(errors)}"
            ) from error


def _missing(shape: Sequence[int]) -> Tensor:
    return torch.full(tuple(shape), torch.nan, dtype=torch.float64, device="cpu")
