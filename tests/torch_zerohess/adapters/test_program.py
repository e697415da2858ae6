"""External programs: what they answer, what they do wrong, and a real one."""

import json
import os
import pickle
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace

import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.adapters import server as servers
from torch_zerohess.adapters.process import Program
from torch_zerohess.evaluators import Executor, ProcessPool
from torch_zerohess.evaluators.partial_values import finished_values
from truths import vector

READ = "import json, sys, time\n"
ANSWER = "print(json.dumps([sum(map(sum, one)) for one in zip(a['x'], *a.get('aux', []))]), flush=True)\n"
SERVE = READ + "for line in sys.stdin:\n    a = json.loads(line)\n    "
Z = torch.tensor([[0.1, 0.2], [1 / 3, 0.4]], dtype=torch.float64)


def python(code: str, **settings) -> Program:
    return Program([sys.executable, "-S", "-c", code], **settings)


@pytest.fixture(scope="module")
def server():
    with python(SERVE + ANSWER, server=True, timeout=30.0) as program:
        yield program


def test_a_program_per_call():
    program = python(READ + "a = json.load(sys.stdin); " + ANSWER)
    assert torch.equal(program(Z), Z.sum(1))
    assert torch.equal(program(Z, torch.ones(2, 1)), Z.sum(1) + 1)


def test_threads_take_turns_with_a_server(server):
    points = torch.arange(40.0)[:, None].double()
    with Executor(ThreadPoolExecutor(4)) as evaluator:
        for _ in range(5):
            assert torch.equal(evaluator(server, points), points[:, 0])


def test_a_function_as_command_gets_no_further_inputs():
    program = Program(lambda x: [sys.executable, "-c", "print(1.0)"], format=float)
    with pytest.raises(ValueError, match="aux must be empty for a command that is a function of x, got 1 tensors"):
        program(Z, torch.ones(2, 1))


def test_a_timeout_is_a_number():
    with pytest.raises(TypeError, match="timeout must be a number, got '3'"):
        python(ANSWER, timeout="3")


def test_a_server_answers_and_keeps_running(server):
    for k in range(5):
        assert torch.equal(server(Z + k), (Z + k).sum(1))
    first = server._server
    assert first.alive
    server(Z)
    assert server._server is first
    assert pickle.loads(pickle.dumps(server))._server is None


def test_a_layer_around_a_server(server):
    x, smoothing = vector(0.3, 0.7), zh.Smoothing(sigma=0.3, samples=4, seed=0)
    slope = torch.func.grad(zh.smooth(server, smoothing))(x)
    torch.testing.assert_close(slope, torch.func.grad(zh.smooth(lambda z: z.sum(1), smoothing))(x))


@pytest.mark.parametrize("server", [False, True])
def test_arrays(server):
    code = (
        "import sys, types, numpy as np\n"
        "while True:\n"
        "    try: x = np.lib.format.read_array(types.SimpleNamespace(read=sys.stdin.buffer.read))\n"
        "    except ValueError: break\n"
        "    np.save(sys.stdout.buffer, np.stack([x, x * 2], 1).astype('f4')); sys.stdout.flush()\n"
    )
    with Program([sys.executable, "-c", code], server=server, format="npy") as program:
        for _ in range(2 if server else 1):
            assert torch.equal(program(Z), torch.stack([Z, 2 * Z], 1).float())


def test_a_server_that_ends_within_an_array_has_no_answer():
    code = "import sys; sys.stdin.buffer.read(9); sys.stdout.buffer.write(b'\\x93NUMPY')"
    with python(code, server=True, format="npy") as program, pytest.raises(RuntimeError, match="without an answer"):
        program(Z)


def test_arrays_of_a_type_that_numpy_does_not_have():
    code = (
        "import sys, types, numpy as np\n"
        "x = np.lib.format.read_array(types.SimpleNamespace(read=sys.stdin.buffer.read))\n"
        "np.save(sys.stdout.buffer, x)\n"
    )
    values = Program([sys.executable, "-c", code], format="npy")(Z.bfloat16())
    assert torch.equal(values, Z.bfloat16().float())


def test_a_command_may_write_to_its_point():
    z = Z.clone()
    assert Program(lambda point: ["echo", str(float(point.zero_().sum()))])(z).tolist() == [0.0, 0.0]
    assert torch.equal(z, Z)


@pytest.mark.parametrize("more", ["b'done'", "one.getvalue()"], ids=["text", "array"])
def test_one_array_and_nothing_after_it(more):
    code = "import io, sys, numpy as np\none = io.BytesIO(); np.save(one, np.ones(2))\n"
    program = Program([sys.executable, "-c", f"{code}sys.stdout.buffer.write(one.getvalue() + {more})"], format="npy")
    with pytest.raises(ValueError, match=r"values as npy and nothing else (.|\n)*it wrote \d+ bytes after the array"):
        program(Z)


def test_a_server_that_prints_is_named_and_started_again():
    with python(SERVE + "print('Loading scene')\n    " + ANSWER, server=True) as program:
        with pytest.raises(ValueError, match="nothing else to its standard output, got 'Loading scene"):
            program(Z)
        assert program._server is None


WRITES = "open(__import__('os').environ['NOTE'], 'w').write('1')"


@pytest.fixture
def note(tmp_path, monkeypatch):
    """A file in the environment. No limit of this process is over before a program has written to it."""
    path, real = tmp_path / "note", time.monotonic

    def clock() -> float:
        return real() + 1e9 if path.exists() and path.read_text().strip() else 0.0

    monkeypatch.setenv("NOTE", str(path))
    monkeypatch.setattr(servers, "time", SimpleNamespace(monotonic=clock))
    monkeypatch.setattr(subprocess, "_time", clock)
    return path


@pytest.mark.parametrize("server", [False, True])
def test_a_program_that_ends_or_hangs_says_why(server, note):
    wrong = READ + "a = sys.stdin.readline(); print('no licence', file=sys.stderr, flush=True); "
    with pytest.raises(TimeoutError, match=r"no answer within timeout: 1 s(.|\n)*no licence"):
        python(wrong + WRITES + "; time.sleep(60)", server=server, timeout=0.5)(Z)
    with pytest.raises(RuntimeError, match=r"ended with code 3 and without an answer(.|\n)*no licence"):
        python(wrong + "sys.exit(3)", server=server)(Z)
    with pytest.raises(
        RuntimeError, match=r"was killed by signal 15 \(SIGTERM\) and without an answer(.|\n)*no licence"
    ):
        python(wrong + "import os; os.kill(os.getpid(), 15)", server=server)(Z)


TWICE = ANSWER.replace("print(json", "print(2 * (json").replace("), flush", ") + chr(10)), end='', flush")


@pytest.mark.parametrize("line", ["3", "[3, 3]"])
def test_a_line_too_many_that_comes_with_the_answer_is_an_error_of_the_call(line):
    """Before the answer it would be taken for it."""
    for code in (TWICE, ANSWER.replace("print(", f"print({line!r} + chr(10) + ")):
        message = r"wrote more than one answer to a request(.|\n)*after the answer"
        with python(SERVE + code, server=True) as program, pytest.raises(ValueError, match=message):
            program(Z)
        with python(SERVE + code, server=True, on_failure="nan") as program:
            assert program(Z).isnan().all()


def test_an_answer_too_many_is_not_taken_for_the_next(tmp_path):
    """It comes when the first call has ended, and is there before the second."""
    wait = f"while not __import__('os').path.exists({str(tmp_path / 'ended')!r}): time.sleep(0.01)\n    "
    with python(SERVE + ANSWER + "    " + wait + ANSWER, server=True) as program:
        assert torch.equal(program(Z), Z.sum(1))
        (tmp_path / "ended").touch()
        until(lambda: servers._pending(program._server.process.stdout))
        with pytest.raises(ValueError, match=r"wrote more than one answer to a request(.|\n)*before the next request"):
            program(2 * Z)
        (tmp_path / "ended").unlink()
        assert torch.equal(program(2 * Z), 2 * Z.sum(1))  # it was started again


STARTS = ["sh", "-c", 'read line; sleep 60 & echo $! > "$NOTE"; wait']
"""A shell that, at a request, waits for a program, and writes the number of that to a file."""


def until(happened) -> None:
    """Wait until something has happened, for at most a minute."""
    deadline = time.monotonic() + 60.0
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def noted(path) -> int:
    until(lambda: path.exists() and path.read_text().strip())
    return int(path.read_text())


def runs(pid: int) -> bool:
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout.strip()
    return bool(state) and not state.startswith("Z")


def has_ended(pid: int) -> bool:
    until(lambda: not runs(pid))
    return True


@pytest.mark.parametrize(
    ("command", "settings"),
    [(STARTS, {}), (STARTS, {"server": True}), (lambda point: STARTS, {"format": float})],
    ids=["once", "server", "function"],
)
def test_programs_that_the_program_started_end_with_it(note, command, settings):
    """They hold the pipes of the program: a call must not wait for them."""
    program = Program(command, timeout=1.0, on_failure="nan", **settings)
    assert program(Z[:1]).isnan().all()
    assert "gave no answer within timeout: 1 s" in program.last_failure
    assert has_ended(noted(note))
    program.close()


def test_in_a_worker_too(tmp_path):
    note = tmp_path / "note"
    program = Program(STARTS, timeout=10.0, environment={"NOTE": str(note)}, on_failure="nan")
    with ProcessPool(1) as pool:
        assert pool(program, Z[:1]).isnan().all()
        assert has_ended(noted(note))
        program.timeout = 60.0
        note.unlink()
        with pytest.raises(KeyboardInterrupt), interrupted(note):
            pool(program, Z[:1])
    assert has_ended(noted(note))


@contextmanager
def interrupted(note):
    """Press Ctrl-C as soon as the program has written its note."""

    def press() -> None:
        noted(note)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    thread = threading.Thread(target=press)
    thread.start()
    try:
        yield
    finally:
        thread.join()


@pytest.mark.parametrize("server", [False, True])
def test_ctrl_c_ends_the_program_and_what_it_started(tmp_path, server):
    note = tmp_path / "note"
    with (
        Program(STARTS, server=server, environment={"NOTE": str(note)}) as program,
        pytest.raises(KeyboardInterrupt),
        interrupted(note),
    ):
        program(Z)
    assert has_ended(noted(note))


def test_a_server_that_is_closed_at_work_leaves_no_pipe_open(tmp_path):
    """Ctrl-C may come at any time, also before the wait for an answer begins."""
    note = tmp_path / "note"
    program = Program(STARTS, server=True, environment={"NOTE": str(note)}, on_failure="nan")
    caller = threading.Thread(target=program, args=(Z,))
    caller.start()
    child = noted(note)
    process = program._server.process
    program.close()
    caller.join()
    assert process.stdin.closed
    assert process.stdout.closed
    assert process.stderr.closed
    assert has_ended(child)


def test_every_wait_is_short(monkeypatch):
    """Python loses a Ctrl-C that comes just before it waits for a lock, until the wait is over."""
    waits = []
    clock = iter(range(100))
    monkeypatch.setattr(servers, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    thread = SimpleNamespace(is_alive=lambda: len(waits) < 3, join=waits.append)
    servers._join(thread, None)
    assert waits == [1.0] * 3
    waits.clear()
    servers._join(thread, 1.5)
    assert waits == [0.5]


def test_a_program_that_left_the_group_is_not_waited_for(note):
    """It may hold the pipes for ever."""
    program = Program([sys.executable, "-S", "-c", LEAVES], timeout=1.0)
    with pytest.raises(TimeoutError, match=r"timeout: 2 s(.|\n)*started"):
        program(Z)
    other = noted(note)
    assert runs(other)
    os.kill(other, signal.SIGKILL)


LEAVES = (
    "import os, subprocess, sys, time\n"
    "print('started', file=sys.stderr, flush=True)\n"
    "child = subprocess.Popen(['sleep', '60'], start_new_session=True)\n"
    "open(os.environ['NOTE'], 'w').write(str(child.pid))\n"
    "time.sleep(60)\n"
)


SQUARE = "a = json.load(sys.stdin)['x']; print('seen', file=sys.stderr); x = a[0][0]; "
FAILURES = {
    "exit": ("sys.exit(3) if x > 1 else None; ", "ended with code 3"),
    "late": (f"({WRITES}, time.sleep(60)) if x > 1 else None; ", "gave no answer within timeout: 1 s"),
    "text": ("print('oh' if x > 1 else '', end=''); ", "nothing else to its standard output, got 'oh"),
    "null": ("x = 'null' if x > 1 else x; ", "it printed null where a number was expected"),
}


@pytest.mark.parametrize(("wrong", "message"), FAILURES.values(), ids=FAILURES)
def test_a_run_that_fails_has_no_value_or_names_its_point(wrong, message, note):
    """One image [2] per point, for one point: the run fails beyond 1."""
    code = READ + SQUARE + "sys.stderr.flush(); " + wrong + "print(f'[[{x}, 7]]')"
    good, bad = torch.tensor([[0.5, 0.25]]).double(), torch.tensor([[1.5, 0.25]]).double()
    program = python(code, on_failure="nan")
    assert program(good).tolist() == [[0.5, 7.0]]
    assert program.last_failure is None
    program.timeout = 1.0 if "timeout" in message else None
    values = program(bad)
    assert values.shape == (1, 2)
    assert bool(values.isnan().all())
    assert program.last_failure.startswith("at the point [1.5, 0.25]: the program")
    assert message in program.last_failure
    assert program.last_failure.endswith("it wrote to its standard error:\nseen")
    program.timeout = None
    assert program(good).tolist() == [[0.5, 7.0]]
    if "timeout" not in message:
        with pytest.raises((RuntimeError, ValueError), match=rf"point \[1.5, 0.25\] and 1 more: (.|\n)*{message}"):
            python(code)(bad.expand(2, 2))


def test_a_command_is_made_when_its_run_begins(tmp_path):
    """It may write the point to a file that the program reads."""

    def command(point: torch.Tensor) -> list[str]:
        (tmp_path / "point").write_text(" ".join(map(str, point.tolist())))
        return ["awk", "{ if ($1 > 4) exit 1; print $1 + $2 }", str(tmp_path / "point")]

    points = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], dtype=torch.float64)
    program = Program(command, format=float)
    assert program(points[:2]).tolist() == [3.0, 7.0]
    with pytest.raises(RuntimeError, match=r"at the point \[5, 6\]") as caught:
        program(points)
    numbers, values = finished_values(caught.value, points)
    assert (numbers, values.tolist()) == ([0, 1], [3.0, 7.0])


def test_values_of_two_shapes_are_named_with_their_points():
    program = Program(lambda point: ["echo", "[1, 2]" if point[0] < 0.2 else "[1, 2, 3]"])
    message = r"at the point \[0\.333333, 0\.4\]: .* values of one shape, \[2\] as before, got \[3\]"
    with pytest.raises(ValueError, match=message):
        program(Z)
    assert program(Z[1:]).shape[1:] == (3,), "another call may have another shape"


@pytest.mark.parametrize("left", [0, 2])
def test_an_output_that_is_cut_off_is_a_failure(left: int) -> None:
    """The program ends without an error."""

    def command(point: torch.Tensor) -> list[str]:
        return ["echo", *["1.5"] * (3 if point[0] < 0.2 else left)]

    def read(output: bytes) -> list[float]:
        return [float(one) for one in output.split()]

    program = Program(command, format=read, on_failure="nan")
    for points in (Z, Z[1:]):  # also where no run of the call has worked
        assert program(points)[-1].isnan().tolist() == [True] * 3
    assert "at the point [0.333333, 0.4]" in program.last_failure
    if not left:
        first = Program(command, format=read, on_failure="nan")(Z[1:])
        assert first.isnan().tolist() == [True]
    with pytest.raises(ValueError, match=r"at the point \[0\.333333, 0\.4\]: the program must write"):
        Program(command, format=read)(Z)


def test_a_search_goes_on_after_a_run_that_failed():
    def command(point: torch.Tensor) -> list[str]:
        x = float(point[0])
        return [
            "awk",
            f'BEGIN {{ if ({x!r} < 0.1) {{ print "below" > "/dev/stderr"; exit 1 }} print ({x!r} - 0.25)^2 }}',
        ]

    program = Program(command, format=float, on_failure="nan")
    below = torch.tensor([[0.75], [0.0]], dtype=torch.float64)
    assert program(below)[:1].tolist() == [0.25]
    assert program(below).isnan().tolist() == [False, True]
    start = torch.ones(1, dtype=torch.float64)
    fit = zh.minimize(program, start, sigma=0.5, bounds=(-1, 1), seed=0, target=1e-6, max_evaluations=60)
    assert fit.status == "target"
    assert bool(torch.isnan(torch.tensor([one.value for one in fit.history])).any())
    with pytest.raises(RuntimeError, match=r"at the point \[0\]: the program 'awk' ended with code 1(.|\n)*below"):
        Program(command, format=float)(below)
    with pytest.raises(ValueError, match=r"at the point \[0.75\]: the program must write what the function `format`"):
        Program(command, format=bytes.hex)(below)
    unknown = Program(command, format=float, on_failure="nan")
    assert unknown(below[1:]).isnan().tolist() == [True]  # one number, as long as no output was seen
    with pytest.raises(FileNotFoundError, match="no program 'no-such'"):
        Program(lambda point: ["no-such"], on_failure="nan")(below)


def test_a_server_that_failed_is_started_again():
    code = SERVE + "x = a['x'][0][0]\n    if x > 1: sys.exit(3)\n    print([x], flush=True)\n"
    with python(code, server=True, on_failure="nan") as program:
        for x, lost in ((0.5, False), (1.5, True), (0.5, False)):
            assert program(torch.tensor([[x]])).isnan().tolist() == [lost]
    assert "ended with code 3" in program.last_failure


def test_a_program_in_the_folder_where_it_runs(tmp_path):
    script = tmp_path / "sim.sh"
    script.write_text("#!/bin/sh\necho 3.5\n")
    script.chmod(0o755)
    for command in (["./sim.sh"], [script], lambda point: ["./sim.sh"]):
        program = Program(command, folder=str(tmp_path), format=lambda out: [float(out)])
        assert program(Z[:1]).flatten().tolist() == [3.5]
    with pytest.raises(FileNotFoundError, match=r"there is no program './other\.sh' that could be run, see folder"):
        Program(["./other.sh"], folder=str(tmp_path))


def test_a_program_in_the_path_that_it_gets(tmp_path):
    script = tmp_path / "only-there"
    script.write_text("#!/bin/sh\necho 3.5\n")
    script.chmod(0o755)
    environment = {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    for command in (["only-there"], lambda point: ["only-there"]):
        program = Program(command, environment=environment, format=lambda out: [float(out)])
        assert program(Z[:1]).flatten().tolist() == [3.5]
    with pytest.raises(FileNotFoundError, match="there is no program 'awk' that could be run, see PATH"):
        Program(["awk"], environment={"PATH": str(tmp_path)})
    Program(["awk"], environment={"OTHER": "1"})


def test_a_relative_path_variable_is_relative_to_the_folder(tmp_path, monkeypatch):
    (tmp_path / "bin").mkdir()
    script = tmp_path / "bin" / "only-there"
    script.write_text("#!/bin/sh\necho 3.5\n")
    script.chmod(0o755)
    mine = f"bin{os.pathsep}{os.environ['PATH']}"
    for environment in ({"PATH": mine}, None):
        for command in (["only-there"], lambda point: ["only-there"]):
            program = Program(command, folder=str(tmp_path), environment=environment, format=lambda out: [float(out)])
            assert program(Z[:1]).flatten().tolist() == [3.5]
        monkeypatch.setenv("PATH", mine)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no program 'only-there'"):
        Program(["only-there"], folder="bin")


def test_no_points_have_no_values():
    program = Program(lambda point: ["echo", "[1, 2]"])
    assert program(Z[:0]).shape == (0,)
    program(Z)
    assert program(Z[:0]).shape == (0, 2)  # as values before it


def test_arguments_are_checked():
    with pytest.raises(FileNotFoundError, match="there is no program 'no-such-program'"):
        Program(["no-such-program", "-x"])
    with pytest.raises(ValueError, match="command must be a list"):
        Program("cat file")
    with pytest.raises(TypeError, match="command must return a list, the program and its arguments, got 'echo 3'"):
        Program(lambda point: "echo 3", on_failure="nan")(torch.zeros(1, 1))
    with pytest.raises(ValueError, match="format must be 'json', 'npy' or a function"):
        Program(["true"], format="xml")
    with pytest.raises(ValueError, match="server=True needs a command that is a list"):
        Program(list, server=True)
    with pytest.raises(ValueError, match="timeout must be positive, got 0"):
        Program(["true"], timeout=0)
    with pytest.raises(ValueError, match="on_failure must be 'raise' or 'nan', got 'drop'"):
        Program(["true"], on_failure="drop")


def quarter(point: torch.Tensor) -> list[str]:
    return ["awk", f'BEGIN {{ printf "%.17g", ({float(point[0])!r} - 0.25)^2 }}']


def test_a_program_takes_no_single_point():
    with pytest.raises(ValueError, match=r"x must be points \[K, n\], got \[1\]: .* leave vectorized=True"):
        zh.minimize(Program(quarter, format=float), torch.zeros(1), sigma=0.2, vectorized=False)


def test_a_program_that_takes_arguments():
    """awk, which every system has: the minimum of a square."""
    assert shutil.which("awk")
    program = Program(quarter, format=float)
    fit = zh.minimize(program, torch.zeros(1, dtype=torch.float64), sigma=0.2, bounds=(-1, 1), seed=0, target=1e-6)
    assert abs(float(fit.x) - 0.25) < 1e-3
    assert fit.evaluations < 30
    assert torch.equal(
        partial(program)(torch.tensor([[0.75]], dtype=torch.float64)), torch.tensor([0.25], dtype=torch.float64)
    )


FORKS = """
import os, signal, sys, threading, time, torch
from torch_zerohess.adapters import server as servers
from torch_zerohess.adapters.process import Program
serve = "import os, sys, time\\nfor line in sys.stdin: time.sleep(0.2); print([os.getpid()], flush=True)"
program, z = Program([sys.executable, "-S", "-c", serve], server=True), torch.ones(1, 2)
first = program(z)
for busy in (False, True):
    thread = threading.Thread(target=program, args=(z,))
    if busy:
        thread.start()
        while not program._asked.locked():
            time.sleep(0.01)
    child = os.fork()
    if not child:
        signal.alarm(30)
        print(torch.equal(program(z), program(z)), torch.equal(program(z), first), flush=True)
        sys.exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), torch.equal(program(z), first), flush=True)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_process_made_by_a_fork_has_a_server_of_its_own():
    """Servers answer with the number of their process. A child that hangs ends by SIGALRM, with code -14.

    Python ends with code 0, and not in an abort over the thread that listens to the server.
    """
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORKS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "True False\n0 True\n" * 2, "")


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: python(ANSWER, environment="A"), TypeError, "environment must be a mapping of names to text, got 'A'"),
        (lambda: python(ANSWER, environment={"A": 1}), TypeError, "must map names to text, got 'A': 1"),
        (lambda: python(ANSWER, folder="/no/such/folder"), FileNotFoundError, "folder must be a folder that exists"),
        (lambda: python(ANSWER, server=3), TypeError, "server must be True or False, got 3"),
        (lambda: Program([sys.executable, "-c", 3.0]), TypeError, r"got 3\.0 in it: write str\(3\.0\)"),
        (lambda: python("print([1.0])")(Z), ValueError, r"one value per point, a list of 2 .*, got \[1\]"),
        (lambda: python(ANSWER)([[1.0]]), TypeError, "x must be a tensor, got list"),
        (lambda: python(ANSWER)(Z[0]), ValueError, r"x must be points \[K, n\], got \[2\]: .* leave vectorized=True"),
    ],
)
def test_wrong_arguments_are_named(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_banner_before_the_numbers_can_be_skipped():
    code = "print('Version 2'); print('ready', flush=True)\nfor line in sys.stdin: "
    code = READ + code + "print([sum(p) for p in json.loads(line)['x']], flush=True)"
    x = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    with pytest.raises(ValueError, match="to its standard error, or skip them in a function `format`"):
        python(code)(x)
    assert python(code, format=lambda output: json.loads(output.splitlines()[-1]))(x).tolist() == [3.0, 7.0]
    command = ["sh", "-c", f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} | sed -u 1,2d"]
    with Program(command, server=True, timeout=60.0) as server:
        assert [server(x).tolist(), server(x[:1]).tolist()] == [[3.0, 7.0], [3.0]]
