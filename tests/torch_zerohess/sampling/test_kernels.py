"""The C++ operators against their literal references in torch: the same bits where promised, else the stated bound."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torch_zerohess.sampling import extension, kernels, philox, proposals
from torch_zerohess.sampling.kernels import Redrawn
from truths import doubles, spread

SIZES = [1, 2, 3, 7, 8, 9, 255, 256, 257, 300, 1024]
DENSITIES = [
    proposals.GAUSSIAN,
    proposals.FIRST_ORDER,
    proposals.SECOND_ORDER,
    proposals.UNIFORM,
    proposals.SIGNED_LOBES,
]
EPS = torch.finfo(torch.float64).eps
ops = torch.ops.torch_zerohess
CPU = torch.device("cpu")
FOLDER = Path(extension.__file__).parents[2]  # of the package under test: a checkout or an installation


def test_extension_is_built() -> None:
    assert extension.available, (
        f"build the extension first (python setup.py build_ext --inplace): {extension.status}; "
        "without it this file would compare the references with themselves"
    )


def every_kind(n: int) -> torch.Tensor:
    """Rows of all kinds, in the first and last dimensions and next to the block boundaries."""
    places = sorted({0, n // 2, n - 1, min(n - 1, 255), min(n - 1, 256)})
    made = [(kind, i, j) for kind in range(6) for i in places for j in places]
    index = torch.arange(len(made))
    seeds = torch.tensor([0, 1, 2**32, 2**63 - 1]).repeat(len(made))[: len(made)]
    return torch.cat([torch.stack([seeds, index * 2**33 + index], 1), torch.tensor(made)], 1)


@pytest.mark.parametrize("density", DENSITIES)
@pytest.mark.parametrize("n", [1, 3, 129])
def test_pick_rows_same_bits(density: int, n: int) -> None:
    for seed, first in ((0, 0), (2**63 - 1, 2**40)):
        assert torch.equal(
            ops.pick_rows(seed, first, 500, n, density), proposals.pick_rows(seed, first, 500, n, density)
        )


@pytest.mark.parametrize("n", SIZES)
def test_draw_same_bits(n: int) -> None:
    rows = every_kind(n)
    for single in (False, True):
        got = ops.draw(rows, n, single)
        assert got.dtype == (torch.float32 if single else torch.float64)
        assert torch.equal(got, proposals.draw(rows, n, single))


@pytest.mark.parametrize("n", SIZES)
def test_parts_of_draws_same_bits(n: int) -> None:
    """Uniforms of any columns, perturbations from uniforms, and lobes in place of perturbations."""
    rows = every_kind(n)
    seed, index = rows[:, 0].contiguous(), rows[:, 1].contiguous()
    for first, stream in ((0, philox.DIMENSIONS), (2, philox.PICKS), (300, philox.EXTRA)):
        p = ops.uniforms(seed, index, first, n, stream)
        assert torch.equal(p, philox.uniforms(seed, index, first, n, stream))
    assert torch.equal(ops.shape(rows, p), proposals.shape(rows, p))
    arguments = rows, p - 0.5, p[:, 0].contiguous(), p[:, -1].contiguous()
    normal = rows[:, 2] < proposals.EVERY_GRADIENT_LOBE
    equal_places = rows[:, 3] == rows[:, 4]
    meant = normal & ((rows[:, 2] != proposals.OFF_DIAGONAL_LOBE) | ~equal_places)
    assert torch.equal(ops.with_lobes(*arguments)[meant], proposals.with_lobes(*arguments)[meant])


def test_draw_same_bits_of_very_many_numbers() -> None:
    # Rare branches too: the normal's far tail begins at a probability of 1e-11, which only made-up uniforms reach (in
    # core_test.cpp); a lobe's slowest convergence, next to its branch points, is met here.
    for kind in (proposals.NORMAL, proposals.EVERY_GRADIENT_LOBE):
        rows = torch.tensor([[3, r, kind, 0, 0] for r in range(100)])
        assert torch.equal(ops.draw(rows, 1000), proposals.draw(rows, 1000))
    rows = torch.tensor([[5, r, proposals.DIAGONAL_LOBE, 0, 0] for r in range(100_000)])
    assert torch.equal(ops.draw(rows, 1), proposals.draw(rows, 1))
    # In single precision one number in 65 536 is in a tail.
    rows = torch.tensor([[3, r, proposals.NORMAL, 0, 0] for r in range(500)])
    got = ops.draw(rows, 1000, True)
    assert int((got.abs() > 4.33).sum()) > 0
    assert torch.equal(got, proposals.draw(rows, 1000, True))


@pytest.mark.parametrize("antithetic", [True, False])
@pytest.mark.parametrize("single", [True, False])
@pytest.mark.parametrize("n", SIZES)
def test_place_same_bits_and_weights_in_bound(n: int, single: bool, antithetic: bool) -> None:
    B, S = 2, 5
    x, sigma = spread(B * n, -3.0, 3.0).view(B, n), spread(n, 1e-9, 2.0)
    if single:
        x = x.float().double()
    for density in DENSITIES:
        u = proposals.draw(proposals.pick_rows(7, 0, B * S, n, density), n)
        got = ops.place(u, x, sigma, antithetic, single, density)
        expected = proposals.place(u, x, sigma, antithetic, single, density)
        assert got[0].dtype == (torch.float32 if single else torch.float64)
        assert torch.equal(got[0], expected[0])
        assert torch.equal(got[1], expected[1])
        # Sums of n terms, divided: n ulps each; the box's exponent is n log(.) - |u|^2 / 2.
        grown = 10 * n if density == proposals.UNIFORM else 0
        assert bool(((got[2] - expected[2]).abs() <= (2 * n + grown + 8) * EPS * expected[2].abs()).all())
        # The perturbation that was drawn, whatever rounding left of it in the point.
        drawn = u.view(B, S, n)
        assert torch.equal(got[1], torch.cat([drawn, -drawn], 1) if antithetic else drawn)


@pytest.mark.parametrize("antithetic", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [1, 3, 256, 257, 700])
def test_sample_is_pick_draw_and_place(n: int, dtype: torch.dtype, antithetic: bool) -> None:
    B, S = 2, 5
    x, sigma = spread(B * n, -3.0, 3.0).view(B, n).to(dtype), spread(n, 1e-9, 2.0)
    single = dtype == torch.float32
    for density in DENSITIES:
        rows = proposals.pick_rows(7, 0, B * S, n, density)
        u = proposals.draw(rows, n, single)
        points, u, weights = proposals.place(u, x.double(), sigma, antithetic, single, density)
        for center in (True, False):
            for keep in (True, False):
                got = ops.sample(7, S, x, sigma, antithetic, density, center, keep)
                assert torch.equal(got[0], rows)
                assert torch.equal(got[1], torch.cat([points, x[:, None]], 1) if center else points)
                assert torch.equal(got[2], u if keep else u[:0])
                # Sums of n terms, in single precision within 2^-20; the box's exponent is n log(.) - |u|^2 / 2.
                grown = 10 * n if density == proposals.UNIFORM else 1
                bound = grown * 2.0**-20 if single else (2 * n + grown + 8) * EPS
                assert bool(((got[3] - weights).abs() <= bound * weights.abs()).all())


def test_sample_without_the_extension(monkeypatch: pytest.MonkeyPatch) -> None:
    x, sigma = spread(20, -3.0, 3.0).view(2, 10).float(), spread(10, 0.1, 2.0)
    for keep in (True, False):
        arguments = (7, 5, x, sigma, True, proposals.SECOND_ORDER, True, keep)
        got = ops.sample(*arguments)
        with monkeypatch.context() as without:
            without.setattr(extension, "available", False)
            without.setattr(kernels, "_CHUNK", 40)  # two rows at a time
            expected = kernels.sample(*arguments)
        assert all(torch.equal(one, other) for one, other in zip(got[:3], expected[:3], strict=True))
        torch.testing.assert_close(got[3], expected[3], rtol=2.0**-20, atol=0.0)


SAME_BITS = """
import hashlib, torch, torch_zerohess
from torch_zerohess.sampling import extension
ops, n = torch.ops.torch_zerohess, 700
assert extension.available
every = torch.tensor([[3, r, kind, r, 5 * r] for kind in range(6) for r in range(20)])
t, a = (torch.linspace(-1, 1, size, dtype=torch.float64).sin().view(1, 2, -1) for size in (2 * n, 480))
half = a[..., :120].contiguous()
made = []
for dtype in (torch.float32, torch.float64):
    made.append(ops.draw(every, n, dtype == torch.float32))
    x, sigma = torch.linspace(-2, 2, n, dtype=dtype)[None], torch.linspace(0.1, 2, n, dtype=torch.float64)
    for proposal in range(5):
        made += ops.sample(2**40 + 1, 6, x, sigma, True, proposal, True, True)
u = ops.draw(every, n)[None]
made += [ops.project(u, t), ops.accumulate(u, half, False), ops.hessian(u, half)]
weight = a[:, 0, :120].exp().contiguous()
made += [ops.coefficients(u[..., :5].contiguous(), None, 119, True), ops.weighted_gradient(u, weight, half)]
made += [ops.weighted_hvp(u, weight, half, t)]
for real in (torch.float32, torch.float64):
    rows, index = u[0, :30].to(real), torch.arange(60).view(20, 3) * 7 % 30
    parts = rows[:, :50], rows[:, 50].abs(), rows[:20, 50:100], index, index % 5 > 0, index, rows[:20, :3]
    ridges, constant = torch.full((2, 2), 0.3, dtype=real), torch.full((50,), 0.02, dtype=real)
    made += ops.regress(*(one.contiguous() for one in parts), ridges, constant, True, True)
for single in (True, False):
    recipe = (every, x, sigma, True, single)
    made += [ops.project_drawn(*recipe, t), ops.accumulate_drawn(*recipe, a, False)]
    made += [ops.accumulate_drawn(*recipe, a, True)]
print(hashlib.sha256(b"".join(one.numpy().tobytes() for one in made)).hexdigest())
"""


def test_every_instruction_set_gives_the_same_bits(capsys: pytest.CaptureFixture) -> None:
    """A processor that lacks AVX2 or AVX-512 runs the best that it has instead."""
    exec(SAME_BITS, {})
    here = capsys.readouterr().out
    assert len(here.strip()) == 64
    for instructions in ("baseline", "avx2"):
        environment = {**os.environ, "TORCH_ZEROHESS_INSTRUCTIONS": instructions}
        command = [sys.executable, "-c", SAME_BITS]
        done = subprocess.run(command, cwd=FOLDER, env=environment, capture_output=True, text=True)
        assert done.stdout == here, instructions + done.stderr


def samples(n: int, K: int, M: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    u = proposals.draw(proposals.pick_rows(1, 0, 2 * K, n, proposals.SECOND_ORDER), n).view(2, K, n)
    return u, spread(2 * M * n, -1.0, 1.0).view(2, M, n), spread(2 * M * K, -1.0, 1.0).view(2, M, K)


def check(got: torch.Tensor, expected: torch.Tensor, magnitudes: torch.Tensor, terms: int) -> None:
    assert got.shape == expected.shape
    assert bool(((got - expected).abs() <= (terms + 2) * EPS * magnitudes).all())


@pytest.mark.parametrize("M", [1, 3, 9])
@pytest.mark.parametrize("n", SIZES)
def test_sums_within_the_bound(n: int, M: int) -> None:
    K = 11
    u, t, a = samples(n, K, M)
    size, squares = u.abs(), u * u
    check(ops.project(u, t), t @ u.mT, t.abs() @ size.mT, n)
    check(ops.accumulate(u, a, False), a @ u, a.abs() @ size, K)
    check(ops.accumulate(u, a, True), a @ squares, a.abs() @ squares, K)
    if n <= 300:
        got, weighted = ops.hessian(u, a), u.mT[:, None] * a[:, :, None]
        check(got, weighted @ u[:, None], weighted.abs() @ size[:, None], K)
        assert torch.equal(got, got.mT)


@pytest.mark.parametrize(("n", "M"), [(3, 2), (3, 9), (64, 8), (65, 9)])
def test_extension_and_matrix_product_agree_within_the_bound(n: int, M: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """`MANY_VECTORS`, `_WIDE` and `_CHUNK` choose the faster of two ways: no result changes beyond rounding."""
    K = 11
    u, t, a = samples(n, K, M)
    size, squares, weighted = u.abs(), u * u, u.mT[:, None] * a[:, :, None]
    for threshold in (0, 10**9):
        for chunk in (1, 1 << 22):
            monkeypatch.setattr(kernels, "MANY_VECTORS", threshold)
            monkeypatch.setattr(kernels, "_WIDE", threshold)
            monkeypatch.setattr(kernels, "_CHUNK", chunk)
            monkeypatch.setattr(kernels, "_STRIP", 7)
            check(kernels.project(u, t), t @ u.mT, t.abs() @ size.mT, n)
            check(kernels.accumulate(u, a), a @ u, a.abs() @ size, K)
            check(kernels.accumulate_squares(u, a), a @ squares, a.abs() @ squares, K)
            got = kernels.hessian(u, a)
            check(got, weighted @ u[:, None], weighted.abs() @ size[:, None], K)
            assert torch.equal(got, got.mT)


@pytest.mark.parametrize("antithetic", [True, False])
@pytest.mark.parametrize("single", [True, False])
@pytest.mark.parametrize("n", [1, 7, 256, 257, 300])
def test_redrawn_equals_stored(n: int, single: bool, antithetic: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    B, S, M = 2, 6, 3
    K = S * (1 + antithetic)
    rows = kernels.pick_rows(3, 0, B * S, n, proposals.SECOND_ORDER, CPU)
    x, sigma = spread(B * n, -3.0, 3.0).view(B, n).float().double(), spread(n, 1e-6, 1.0)
    u = kernels.place(kernels.draw(rows, n, single), x, sigma, antithetic, single, proposals.GAUSSIAN)[1]
    redrawn = Redrawn(rows, x, sigma, antithetic, single)
    t, a = spread(B * M * n, -1.0, 1.0).view(B, M, n), spread(B * M * K, -1.0, 1.0).view(B, M, K)
    drawn = kernels.project(redrawn, t), kernels.accumulate(redrawn, a), kernels.accumulate_squares(redrawn, a)
    kept = kernels.project(u, t), kernels.accumulate(u, a), kernels.accumulate_squares(u, a)
    for one, other in zip(drawn, kept, strict=True):
        assert torch.equal(one, other)
    outer = kernels.hessian(u, a)
    torch.testing.assert_close(kernels.hessian(redrawn, a), outer, rtol=0.0, atol=K * EPS * float(outer.abs().max()))
    # The reference draws chunk by chunk; two rows at a time here.
    monkeypatch.setattr(extension, "available", False)
    monkeypatch.setattr(kernels, "_CHUNK", 2 * B * n)
    again = kernels.project(redrawn, t), kernels.accumulate(redrawn, a), kernels.accumulate_squares(redrawn, a)
    for one, other, terms in zip(again, kept, (n, K, K), strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=10 * terms * EPS * float(1 + other.abs().max()))
    torch.testing.assert_close(kernels.hessian(redrawn, a), outer, rtol=0.0, atol=K * EPS * float(outer.abs().max()))


def test_any_number_of_threads_gives_the_same_bits() -> None:
    """Threads share nothing: each writes elements of its own, in ranges that `parallel_for` cuts."""
    n, B, S, M = 300, 2, 150, 3
    rows = kernels.pick_rows(11, 0, B * S, n, proposals.SECOND_ORDER, CPU)
    x, sigma = torch.zeros(B, n, dtype=torch.float64), torch.ones(n, dtype=torch.float64)
    t, a = spread(B * M * n, -1.0, 1.0).view(B, M, n), spread(B * M * 2 * S, -1.0, 1.0).view(B, M, 2 * S)

    def everything() -> list[torch.Tensor]:
        drawn = ops.draw(rows, n)
        points, u, weights = ops.place(drawn, x, sigma, True, False, proposals.SECOND_ORDER)
        sampled = ops.sample(11, S, x.float(), sigma, True, proposals.SECOND_ORDER, True, True)
        recipe = (rows, x, sigma, True, False)
        sums = [ops.project(u, t), ops.accumulate(u, a, False), ops.accumulate(u, a, True), ops.hessian(u, a)]
        sums += [ops.project_drawn(*recipe, t), ops.accumulate_drawn(*recipe, a, False)]
        mirrored = spread(n * n, -1.0, 1.0).view(1, n, n)
        ops.mirror(mirrored)
        parts = [
            ops.uniforms(rows[:, 0].contiguous(), rows[:, 1].contiguous(), 0, n, 2),
            ops.shape(rows, drawn.sigmoid()),
        ]
        index, numbers = torch.arange(6000).view(2000, 3) % n, spread(6000, -1.0, 1.0)
        entries, few = (index.flatten(), torch.arange(0, 6000, 3), numbers), numbers.view(2000, 3)
        parts.append(ops.sparse_times(*entries, t[0, 0]))
        regressions = (t[0].mT.contiguous(), t[0, 0].abs(), few, index, index > 4, index, few, few[:5, :2].contiguous())
        parts += ops.regress(*regressions, None, True, True)
        whole = [drawn, points, u, weights, mirrored, *parts]
        return [*whole, *sampled, *sums, ops.accumulate_drawn(*recipe, a, True)]

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = everything()
        for threads in (2, 3, 5, 8):
            torch.set_num_threads(threads)
            assert all(torch.equal(p, q) for p, q in zip(one, everything(), strict=True)), threads
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("n", [1, 2, 31, 32, 33, 100])
def test_mirror_copies_the_upper_triangle(n: int) -> None:
    matrices = spread(2 * n * n, -1.0, 1.0).view(2, n, n)
    expected = matrices.triu() + matrices.triu(1).mT
    ops.mirror(matrices)
    assert torch.equal(matrices, expected)


def test_noncontiguous_inputs() -> None:
    u, t, a = samples(9, 6, 2)
    turned = [one.mT.contiguous().mT for one in (u, t, a)]
    assert not any(one.is_contiguous() for one in turned)
    v, s, b = turned
    for function, other in ((kernels.project, (t, s)), (kernels.accumulate, (a, b)), (kernels.hessian, (a, b))):
        assert torch.equal(function(v, other[1]), function(u, other[0]))
    assert torch.equal(kernels.accumulate_squares(v, b), kernels.accumulate_squares(u, a))
    rows = every_kind(9)
    assert torch.equal(kernels.draw(rows[::2], 9), kernels.draw(rows[::2].contiguous(), 9))
    with pytest.raises(RuntimeError, match="contiguous"):
        ops.project(v, t)


def recipe(rows: int = 4, sigma: int = 3, columns: int = 5) -> tuple:
    return torch.zeros(rows, columns, dtype=torch.int64), doubles(2, 3), doubles(sigma), True, False


COUNTS = torch.arange(4)
WRONG = {
    "pick_rows: negative count": lambda: ops.pick_rows(0, 0, -1, 3, 0),
    "pick_rows: no parameters": lambda: ops.pick_rows(0, 0, 4, 0, 0),
    "draw: dimensions": lambda: ops.draw(torch.zeros(5, dtype=torch.int64), 3),
    "place: dimensions of u": lambda: ops.place(doubles(3), doubles(2, 3), doubles(3), True, False, 0),
    "place: dimensions of x": lambda: ops.place(doubles(4, 3), doubles(3), doubles(3), True, False, 0),
    "draw: columns of rows": lambda: ops.draw(torch.zeros(2, 4, dtype=torch.int64), 3),
    "draw: type of rows": lambda: ops.draw(doubles(2, 5), 3),
    "draw: negative n": lambda: ops.draw(torch.zeros(2, 5, dtype=torch.int64), -1),
    "place: n": lambda: ops.place(doubles(4, 3), doubles(2, 2), doubles(2), True, False, 0),
    "place: sigma": lambda: ops.place(doubles(4, 3), doubles(2, 3), doubles(1), True, False, 0),
    "place: rows not a multiple": lambda: ops.place(doubles(5, 3), doubles(2, 3), doubles(3), True, False, 0),
    "place: empty": lambda: ops.place(doubles(0, 3), doubles(0, 3), doubles(3), True, False, 0),
    "place: float32": lambda: ops.place(doubles(4, 3).float(), doubles(2, 3), doubles(3), True, False, 0),
    "uniforms: odd column": lambda: ops.uniforms(COUNTS, COUNTS, 1, 3, 0),
    "uniforms: negative count": lambda: ops.uniforms(COUNTS, COUNTS, 0, -1, 0),
    "uniforms: rows": lambda: ops.uniforms(COUNTS, COUNTS[:2], 0, 3, 0),
    "uniforms: type": lambda: ops.uniforms(doubles(4), COUNTS, 0, 3, 0),
    "shape: rows": lambda: ops.shape(recipe()[0], doubles(3, 3)),
    "shape: dimensions": lambda: ops.shape(recipe()[0], doubles(4)),
    "with_lobes: rows": lambda: ops.with_lobes(recipe()[0], doubles(3, 3), doubles(3), doubles(3)),
    "with_lobes: uniforms": lambda: ops.with_lobes(recipe()[0], doubles(4, 3), doubles(4), doubles(3)),
    "project: n": lambda: ops.project(doubles(1, 4, 3), doubles(1, 2, 4)),
    "project: batch": lambda: ops.project(doubles(2, 4, 3), doubles(1, 2, 3)),
    "project: dimensions of u": lambda: ops.project(doubles(4, 3), doubles(1, 2, 3)),
    "project: dimensions of t": lambda: ops.project(doubles(1, 4, 3), doubles(1, 3)),
    "accumulate: K": lambda: ops.accumulate(doubles(1, 4, 3), doubles(1, 2, 5), False),
    "accumulate: dimensions": lambda: ops.accumulate(doubles(1, 4, 3), doubles(1, 4), False),
    "hessian: K": lambda: ops.hessian(doubles(1, 4, 3), doubles(1, 2, 5)),
    "mirror: square": lambda: ops.mirror(doubles(1, 3, 4)),
    "mirror: dimensions": lambda: ops.mirror(doubles(3, 3)),
    "sample: no samples": lambda: ops.sample(0, 0, doubles(2, 3), doubles(3), True, 0, True, True),
    "sample: sigma": lambda: ops.sample(0, 4, doubles(2, 3), doubles(2), True, 0, True, True),
    "sample: no batch": lambda: ops.sample(0, 4, doubles(0, 3), doubles(3), True, 0, True, True),
    "sample: type of x": lambda: ops.sample(0, 4, doubles(2, 3).half(), doubles(3), True, 0, True, True),
    "hessian: float32": lambda: ops.hessian(doubles(1, 4, 3).float(), doubles(1, 2, 4)),
    "project_drawn: n": lambda: ops.project_drawn(*recipe(), doubles(2, 1, 4)),
    "project_drawn: sigma": lambda: ops.project_drawn(*recipe(sigma=1), doubles(2, 1, 3)),
    "project_drawn: columns of rows": lambda: ops.project_drawn(*recipe(columns=4), doubles(2, 1, 3)),
    "project_drawn: rows not a multiple": lambda: ops.project_drawn(*recipe(rows=5), doubles(2, 1, 3)),
    "project_drawn: dimensions of t": lambda: ops.project_drawn(*recipe(), doubles(2, 3)),
    "project_drawn: dimensions of rows": lambda: ops.project_drawn(doubles(2).long(), *recipe()[1:], doubles(2, 1, 3)),
    "accumulate_drawn: dimensions of a": lambda: ops.accumulate_drawn(*recipe(), doubles(2, 4), False),
    "accumulate_drawn: K": lambda: ops.accumulate_drawn(*recipe(), doubles(2, 1, 5), False),
    "accumulate_drawn: sigma": lambda: ops.accumulate_drawn(*recipe(sigma=1), doubles(2, 1, 4), False),
    "accumulate_drawn: rows not a multiple": lambda: ops.accumulate_drawn(*recipe(rows=5), doubles(2, 1, 4), False),
}


@pytest.mark.parametrize("proposal", [-1, 5])
@pytest.mark.parametrize("module", [ops, proposals])
def test_numbers_of_no_proposal_are_named(module, proposal: int, capfd: pytest.CaptureFixture[str]) -> None:
    x, sigma = doubles(2, 3), torch.ones(3, dtype=torch.float64)
    with pytest.raises((RuntimeError, ValueError), match=f"proposal is {proposal}, but must be from 0 to 4"):
        module.pick_rows(0, 0, 4, 3, proposal)
    with pytest.raises((RuntimeError, ValueError), match=f"proposal is {proposal}, but must be from 0 to 4"):
        module.place(doubles(4, 3), x, sigma, True, False, proposal)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("kind", [-1, 6])
def test_numbers_of_no_kind_are_named(kind: int, capfd: pytest.CaptureFixture[str]) -> None:
    rows = torch.zeros(2, 5, dtype=torch.int64)
    rows[1, 2] = kind
    with pytest.raises(RuntimeError, match=f"the kind of row 1 is {kind}, but must be from 0 to 5"):
        ops.draw(rows, 3, False)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("call", WRONG.values(), ids=WRONG.keys())
def test_wrong_shapes_raise(call, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises((RuntimeError, IndexError)):
        call()
    assert capfd.readouterr().err == "", "LibTorch was asked about an argument that was not checked"


@pytest.mark.parametrize("shape", [(4, 3), (0, 3), (4, 0), (0, 0)])
def test_results_lie_in_memory_as_those_of_torch(shape: tuple[int, int]) -> None:
    R, n = shape
    rows = proposals.pick_rows(0, 0, R, max(n, 1), proposals.GAUSSIAN)
    for single in (True, False):
        got = ops.draw(rows, n, single)
        expected = torch.empty(shape, dtype=torch.float32 if single else torch.float64)
        assert (got.dtype, got.stride(), got.device) == (expected.dtype, expected.stride(), expected.device)
    assert ops.pick_rows(0, 0, R, 1, 0).stride() == torch.empty(R, 5).stride()


def test_no_batch_at_all_raises_and_does_not_end_the_process() -> None:
    script = (
        "import torch, torch_zerohess\n"
        "rows, none = torch.zeros(4, 5, dtype=torch.int64), torch.zeros(0, 3, dtype=torch.float64)\n"
        "t = none[:, None]\n"
        "for name, last in (('project_drawn', (t,)), ('accumulate_drawn', (t, False))):\n"
        "    try:\n"
        "        getattr(torch.ops.torch_zerohess, name)(rows, none, torch.ones(3).double(), True, False, *last)\n"
        "    except RuntimeError:\n"
        "        print('raised')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=FOLDER, capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, ["raised", "raised"]), done.stderr


SAME_ESTIMATES = """
import torch, torch_zerohess as zh
from torch_zerohess.sampling import extension
for sampler in ("random", "sobol", "orthogonal"):
    x = torch.linspace(-1, 1, 5, dtype=torch.float64)
    e = zh.estimate(lambda z: z.sin().prod(1), x, zh.Smoothing(sigma=0.5, samples=8, sampler=sampler, seed=3))
    print(e.points.sum().item().hex(), *e.hvp(x).tolist())
print(extension.available)
"""


def test_pure_torch_gives_the_same_estimates(capsys: pytest.CaptureFixture) -> None:
    exec(SAME_ESTIMATES, {})
    environment = {**os.environ, "TORCH_ZEROHESS_PURE_TORCH": "1"}
    command = [sys.executable, "-W", "error", "-c", SAME_ESTIMATES]
    done = subprocess.run(command, cwd=FOLDER, env=environment, capture_output=True, text=True, check=True)
    here, there = (text.splitlines() for text in (capsys.readouterr().out, done.stdout))
    assert [here.pop(), there.pop()] == ["True", "False"]
    for compiled, pure in zip(here, there, strict=True):
        points, *hvp = compiled.split()
        assert pure.split()[0] == points
        assert [float(v) for v in pure.split()[1:]] == pytest.approx([float(v) for v in hvp], rel=1e-12)


def test_missing_extension_warns_once_and_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch_zerohess._C", None)
    with pytest.warns(RuntimeWarning, match="C\\+\\+20 compiler") as caught:
        available, reason = extension._load()
    assert len(caught) == 1
    assert not available
    assert "_C" in reason
