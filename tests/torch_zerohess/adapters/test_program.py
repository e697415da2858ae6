"""External programs: what they answer, what they do wrong, and a real one."""

import pickle
import shutil
import sys
from functools import partial

import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.adapters.process import Program
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
        "import io, sys, numpy as np\n"
        "from numpy.lib import format as f\n"
        "def read(i=sys.stdin.buffer):\n"
        "    v = f.read_magic(i); s, _, d = f.read_array_header_1_0(i)\n"
        "    return np.frombuffer(i.read(int(np.prod(s)) * d.itemsize), d).reshape(s)\n"
        "while True:\n"
        "    try: x = read()\n"
        "    except ValueError: break\n"
        "    o = io.BytesIO(); np.save(o, np.stack([x, x * 2], 1).astype('f4'))\n"
        "    sys.stdout.buffer.write(o.getvalue()); sys.stdout.flush()\n"
    )
    with Program([sys.executable, "-c", code], server=server, format="npy") as program:
        for _ in range(2 if server else 1):
            assert torch.equal(program(Z), torch.stack([Z, 2 * Z], 1).float())


def test_a_server_that_prints_is_named_and_started_again():
    with python(SERVE + "print('Loading scene')\n    " + ANSWER, server=True) as program:
        with pytest.raises(ValueError, match="nothing else to its standard output, got 'Loading scene"):
            program(Z)
        assert program._server is None


def test_a_program_that_ends_or_hangs_says_why(server):
    wrong = READ + "a = sys.stdin.readline(); print('no licence', file=sys.stderr, flush=True); "
    for one in (False, True):
        with pytest.raises(RuntimeError, match=r"ended with code 3 and without an answer(.|\n)*no licence"):
            python(wrong + "sys.exit(3)", server=one)(Z)
        with pytest.raises(TimeoutError, match=r"no answer within timeout: 1 s(.|\n)*no licence"):
            python(wrong + "time.sleep(60)", server=one, timeout=0.5)(Z)


def test_arguments_are_checked():
    with pytest.raises(FileNotFoundError, match="there is no program 'no-such-program'"):
        Program(["no-such-program", "-x"])
    with pytest.raises(ValueError, match="command must be a list"):
        Program("cat file")
    with pytest.raises(ValueError, match="format must be 'json', 'npy' or a function"):
        Program(["true"], format="xml")
    with pytest.raises(ValueError, match="server=True needs a command that is a list"):
        Program(list, server=True)
    with pytest.raises(ValueError, match="timeout must be seconds > 0 or None, got 0"):
        Program(["true"], timeout=0)


def quarter(point: torch.Tensor) -> list[str]:
    return ["awk", f'BEGIN {{ printf "%.17g", ({float(point[0])!r} - 0.25)^2 }}']


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
