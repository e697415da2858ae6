"""The Triton kernels against the C++ operators and the torch references, bit for bit, in Triton's interpreter.

No GPU runs here. What the interpreter does not see, contraction and approximate functions of the device, is looked for
in the PTX that the kernels are compiled to.
"""

import ast
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from torch_zerohess.sampling import extension, kernels, on_cuda, proposals

FOLDER = Path(extension.__file__).parents[2]  # of the package under test: a checkout or an installation
needs_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")

SAME_BITS = """
import torch, triton, triton.language as tl
from torch_zerohess.sampling import philox, proposals, quantiles, triton_kernels, triton_quantiles

assert triton_kernels._sample.__class__.__name__ == "InterpretedFunction"
ops = torch.ops.torch_zerohess
SEEDS = torch.tensor([0, 1, 2**32 + 1, 2**63 - 1, -5])


def rows(made):
    index = torch.arange(len(made))
    return torch.cat([torch.stack([SEEDS[index % 5], index * (2**33 + 1)], 1), torch.tensor(made)], 1)


every = rows([(kind, i, j) for kind in range(6) for i in range(3) for j in range(3)])
edges = rows([(proposals.OFF_DIAGONAL_LOBE, 20, 15), (proposals.DIAGONAL_LOBE, 16, 16)])
alone = rows([(kind, 0, 0) for kind in range(6)])
for tile, made, n in ((1024, every, 3), (16, edges, 21), (32, alone, 1)):
    triton_kernels._TILE = tile  # the second: two blocks of columns, the last one not full
    for single in (False, True):
        expected = ops.draw(made, n, single)
        assert torch.equal(expected, proposals.draw(made, n, single))
        assert torch.equal(triton_kernels.draw(made, n, single), expected), (n, single)

triton_kernels._TILE = 1 << 15
tails = torch.tensor([[3, r, proposals.NORMAL, 0, 0] for r in range(32)])
assert int((ops.draw(tails, 1024, True).abs() > 4.33).sum()) > 0
assert torch.equal(triton_kernels.draw(tails, 1024, True), ops.draw(tails, 1024, True))

triton_kernels._TILE = 16
index = torch.tensor([2**40, -1])
for first in (2**32 - 4, 2**33 - 6):  # the counter of blocks of two columns ends at 2^32
    got = triton_kernels.uniforms(SEEDS[3:], index, first, 19, philox.EXTRA)
    assert torch.equal(got, philox.uniforms(SEEDS[3:], index, first, 19, philox.EXTRA))
    assert torch.equal(got, ops.uniforms(SEEDS[3:], index, first, 19, philox.EXTRA))

triton_kernels._TILES = 2
for proposal in range(5):
    triton_kernels._TILE = 8 if proposal == proposals.SECOND_ORDER else 64
    for dtype, B, S, n, both in ((torch.float32, 2, 3, 5, True), (torch.float64, 1, 1, 18, proposal % 2 == 0)):
        x, sigma = torch.linspace(-3, 3, B * n, dtype=dtype).view(B, n), torch.linspace(1e-9, 2, n).double()
        center, keep, single = proposal != 1, proposal != 2, dtype == torch.float32
        got = triton_kernels.sample(2**40 + 1, S, x, sigma, both, proposal, center, keep)
        expected = ops.sample(2**40 + 1, S, x, sigma, both, proposal, center, keep)
        assert all(torch.equal(p, q) for p, q in zip(got[:3], expected[:3], strict=True)), (proposal, dtype)
        u = proposals.draw(got[0], n, single)
        weights = proposals.place(u, x.double(), sigma, both, single, proposal)[2]
        bound = 2.0**-52 * (12 * n + 8 if proposal == proposals.UNIFORM else 2 * n + 9)
        assert bool(((got[3] - weights).abs() <= bound * weights).all())

triton_kernels._TILE, triton_kernels._PROGRAMS = 64, 2
for case, (made, B, n, M) in enumerate([(every, 2, 5, 1), (every, 2, 5, 3), (edges, 1, 70, 2), (every, 1, 2, 5)]):
    single, both, S = case % 2 == 0, case != 2, len(made) // B
    x, sigma = torch.zeros(B, n, dtype=torch.float32 if single else torch.float64), torch.ones(n).double()
    t, a = torch.linspace(-1, 2, B * M * n).double(), torch.linspace(-2, 1, B * M * S * (1 + both)).double()
    sums = [("project_drawn", t.view(B, M, n)), *2 * [("accumulate_drawn", a.view(B, M, -1))]]
    for squares, (name, vectors) in enumerate(sums):
        arguments = made, x, sigma, both, single, vectors, *([squares == 2] if squares else [])
        got, expected = getattr(triton_kernels, name)(*arguments), getattr(ops, name)(*arguments)
        torch.testing.assert_close(got, expected, rtol=1e-13, atol=1e-13)


@triton.jit
def all_quantiles(p, out, N: tl.constexpr):
    here = tl.arange(0, N)[None, :]
    tl.store(out + here, triton_quantiles.normal(tl.load(p + here)))
    tl.store(out + N + here, triton_quantiles.gradient_lobe(tl.load(p + here)))
    tl.store(out + 2 * N + here, triton_quantiles.hessian_lobe(tl.load(p + here)))


p = torch.linspace(0.001, 0.999, 151, dtype=torch.float64)
steps = 2.0 ** torch.arange(-50, -15, dtype=torch.float64)  # next to branch points, and in the far tail
p = torch.cat([p, steps, 0.25 - steps, 0.25 + steps])
p = torch.cat([p, 1.0 - p])
out = torch.empty(3, len(p), dtype=torch.float64)
all_quantiles[(1,)](p, out, len(p))
for got, quantile in zip(out, ("normal_quantile", "gradient_lobe_quantile", "hessian_lobe_quantile"), strict=True):
    assert torch.equal(got, getattr(quantiles, quantile)(p)), quantile
"""

PTX = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from torch_zerohess.sampling import triton_kernels


def compiled(kernel, types, **constants):
    signature = {name: "constexpr" if name in constants else types.get(name, "i32") for name in kernel.arg_names}
    source = ASTSource(kernel, signature, constants)
    made = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=triton_kernels._OPTIONS)
    print(made.asm["ptx"])


for x, single in (("*fp64", False), ("*fp32", True)):
    sums = {"rows": "*i64", "lobes": x, "ratios": "*i64", "t": "*fp64", "a": "*fp64", "out": "*fp64"}
    types = {**sums, "x": x, "points": x, "sigma": "*fp64", "out": x, "sums": "*fp64"}
    any_kind = {"KIND": triton_kernels.ANY.value, "SINGLE": single}
    one, many = {**any_kind, "ROWS": 1, "BLOCK": 128}, {**any_kind, "ROWS": 32, "BLOCK": 4}
    compiled(triton_kernels._sample, types, SIGNS=2, TILES=2, **(one if single else many))
    compiled(triton_kernels._project, sums, **(many if single else one))
    if single:
        compiled(triton_kernels._accumulate, sums, SQUARES=True, **one)
    compiled(triton_kernels._lobes, {"rows": "*i64", "values": x}, SINGLE=single, ROWS=32)
"""


def python(code: str, folder: Path, **environment: str) -> str:
    """Run a file, which is where triton looks for the source of a kernel; return what it prints."""
    script = folder / "script.py"
    script.write_text(code)
    settings = {**os.environ, "PYTHONPATH": str(FOLDER), "TRITON_CACHE_DIR": str(folder / "cache"), **environment}
    done = subprocess.run([sys.executable, str(script)], cwd=folder, env=settings, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@needs_triton
def test_same_bits_in_the_interpreter(tmp_path: Path) -> None:
    python(SAME_BITS, tmp_path, TRITON_INTERPRET="1")


@needs_triton
def test_every_operation_of_the_compiled_kernels_is_rounded_to_nearest(tmp_path: Path) -> None:
    ptx = python(PTX, tmp_path)
    operations = set(re.findall(r"^\s+(?:@\S+ )?([a-z]+\.[\w.]+)", ptx, re.MULTILINE))
    arithmetic = {
        one for one in operations if re.match(r"(add|sub|mul|div|sqrt|fma|mad|rcp|ex2|lg2).*\.f(32|64)$", one)
    }
    assert arithmetic >= {"div.rn.f64", "sqrt.rn.f64", "mul.rn.f64", "mul.rn.f32", "add.rn.f32"}
    assert not {one for one in arithmetic if ".rn." not in one or one.startswith(("fma", "mad"))}


def test_float32_holds_what_is_compared() -> None:
    """Triton 3.6 rounds a number to float32 where float64 is compared with it."""
    sources = [Path(kernels.__file__).with_name(f"triton_{name}.py").read_text() for name in ("quantiles", "kernels")]
    compared = [node for one in sources for node in ast.walk(ast.parse(one)) if isinstance(node, ast.Compare)]
    ends = [one for node in compared for one in (node.left, *node.comparators)]
    ends = [one.operand if isinstance(one, ast.UnaryOp) else one for one in ends]
    numbers = {one.value for one in ends if isinstance(one, ast.Constant) and isinstance(one.value, float)}
    assert numbers >= {0.0, 0.25, 0.75, 0.5, 5.0}
    assert all(float(torch.tensor(one, dtype=torch.float32)) == one for one in numbers)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch):
    """What draws on a device, here a CPU whose memory Triton could reach."""
    on_cuda._triton_kernels.cache_clear()
    registered = {}
    monkeypatch.setattr(torch.library, "impl", lambda name, device, run: registered.update({name: (device, run)}))
    for function in (kernels.draw, kernels.uniforms, kernels.sample):
        on_cuda.on_cuda(function)
    assert {device for device, _ in registered.values()} == {"cuda"}
    monkeypatch.setattr(on_cuda, "_TRITON", True)
    monkeypatch.setattr(on_cuda, "_refused", set())
    yield registered["torch_zerohess::draw"][1]
    on_cuda._triton_kernels.cache_clear()


def test_wrong_arguments_do_not_switch_triton_off(run, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference raises for them, too."""
    rows = proposals.pick_rows(3, 0, 4, 5, proposals.SECOND_ORDER)
    stand_in = SimpleNamespace(draw=proposals.draw)
    monkeypatch.setitem(sys.modules, "torch_zerohess.sampling.triton_kernels", stand_in)
    with pytest.raises((RuntimeError, IndexError)):
        run(rows[:, :3], 5, False)
    assert on_cuda.by_triton(rows.device)
    assert torch.equal(run(rows, 5, False), proposals.draw(rows, 5))


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (None, "ModuleNotFoundError"),  # its import fails
        (SimpleNamespace(draw=lambda rows, n, single: torch.zeros(len(rows), n)), "differ from the reference"),
    ],
)
def test_where_triton_fails_the_reference_draws_and_a_warning_says_so(
    module: SimpleNamespace | None, message: str, run, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = proposals.pick_rows(3, 0, 4, 5, proposals.SECOND_ORDER)
    monkeypatch.setitem(sys.modules, "torch_zerohess.sampling.triton_kernels", module)
    with pytest.warns(RuntimeWarning, match=f"torch, not Triton, on cpu.*{message}"):
        got = run(rows, 5, False)
    assert torch.equal(got, proposals.draw(rows, 5))
    assert torch.equal(run(rows, 5, False), got)  # and no second warning
    assert not on_cuda.by_triton(rows.device)
    assert on_cuda.by_triton(torch.device("cuda", 1))  # another device may have it
