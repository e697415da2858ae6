"""The sparse Jacobian as a matrix, its selection and its regression, on linear maps whose Jacobian is known.

Random tests have fixed seeds. Limits of shares are from binomial errors or stated beside them.
"""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torch_zerohess.sampling import extension
from torch_zerohess.surrogates import sparse_fit, sparse_selection
from torch_zerohess.surrogates.sparse_fit import SparseSettings, _subset, check_samples, fit_sparse
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.surrogates.sparse_selection import Grids, largest, spaced, thresholds
from truths import normal, vector


def sparse_map(m, n, s):
    """A map [m, n] with s entries of size 1 to 2 per row."""
    generator = torch.Generator().manual_seed(0)
    places = torch.stack([torch.randperm(n, generator=generator)[:s] for _ in range(m)])
    sizes = (1 + torch.rand(m, s, generator=generator).double()) * torch.randn(m, s, generator=generator).sign()
    return torch.zeros(m, n).double().scatter_(1, places, sizes)


def explained_by(J, u, changes):
    """Share of the changes [K, m] along u [K, n], less their mean, that a Jacobian predicts."""
    u, changes = u - u.mean(0), changes - changes.mean(0)
    return 1.0 - float((changes - u @ J.dense().mT).square().sum() / changes.square().sum())


def random_jacobian():
    """A Jacobian of outputs [2, 3] of 7 parameters with 3 entries per row, and the same as a matrix [6, 7]."""
    index, used = largest(torch.arange(6).repeat_interleave(3), torch.arange(18) % 7, torch.ones(18), 6, 4)
    values = normal(6, 4) * used
    dense = torch.zeros(6, 7).double()
    for p in range(6):
        for j in range(4):
            dense[p, index[p, j]] += values[p, j]
    return SparseJacobian(index, values, values.abs(), 7, torch.Size([2, 3])), dense


def test_products_are_those_of_the_dense_matrix():
    J, dense = random_jacobian()
    v, w = normal(7, seed=1), normal(2, 3, seed=2)
    torch.testing.assert_close(J.dense(), dense.view(2, 3, 7))
    torch.testing.assert_close(J.matvec(v).flatten(), dense @ v)
    torch.testing.assert_close(J.rmatvec(w), dense.mT @ w.flatten())
    torch.testing.assert_close(J.squared_lengths, dense.square().sum(0))
    torch.testing.assert_close(J.untouched, (dense == 0).all(0))
    many, images = normal(2, 5, 7, seed=3), normal(2, 5, 2, 3, seed=4)
    torch.testing.assert_close(J.matvec(many).flatten(2), many @ dense.mT)
    torch.testing.assert_close(J.rmatvec(images), images.flatten(2) @ dense)
    with pytest.raises(ValueError, match=r"v must have shape \[\*batch, 7\], got \[6\]"):
        J.matvec(v[:6])
    with pytest.raises(ValueError, match=r"w must have shape \[\*batch, 2, 3\], got \[6\]"):
        J.rmatvec(w.flatten())
    with pytest.raises(TypeError, match=r"v must be a real floating tensor, got torch.int64"):
        J.matvec(torch.ones(7, dtype=torch.int64))


def test_products_have_derivatives_of_every_order_in_every_mode():
    J, dense = random_jacobian()
    v, t = normal(5, 7, seed=1), normal(5, 7, seed=2)

    def cubes(one, matvec=J.matvec, rmatvec=J.rmatvec):
        return rmatvec(matvec(one) ** 3).sum()

    def truth(one):
        return cubes(one, lambda z: (z @ dense.mT).unflatten(-1, (2, 3)), lambda w: w.flatten(-2) @ dense)

    torch.testing.assert_close(torch.func.hessian(cubes)(v), torch.func.hessian(truth)(v))
    torch.testing.assert_close(torch.func.jacrev(torch.func.jacrev(cubes))(v), torch.func.hessian(truth)(v))
    torch.testing.assert_close(torch.func.jvp(cubes, (v,), (t,))[1], torch.func.jvp(truth, (v,), (t,))[1])
    torch.testing.assert_close(torch.func.vmap(torch.func.grad(cubes))(v), torch.func.vmap(torch.func.grad(truth))(v))
    assert torch.autograd.gradgradcheck(cubes, v.requires_grad_())


def test_compiled_products_and_their_gradients_are_those_of_the_dense_matrix():
    """Rows 3 and 5 are empty, and so is column 4."""
    index = torch.tensor([[0, 3], [2, 0], [6, 1], [0, 0], [5, 2], [0, 0]])
    values = torch.tensor([[1.0, 2.0], [5.0, 0.0], [3.0, -1.0], [0.0, 0.0], [4.0, 1.0], [0.0, 0.0]]).double()
    J, dense = SparseJacobian(index, values, values.abs(), 7, torch.Size([6])), torch.zeros(6, 7).double()
    dense.scatter_add_(1, index, values)
    for method, matrix in ((J.matvec, dense), (J.rmatvec, dense.mT)):
        at = normal(2, matrix.shape[1])
        gradient = torch.compile(torch.func.grad(lambda z, m=method: m(z).sin().sum()), fullgraph=True, backend="eager")
        torch.testing.assert_close(gradient(at), (at @ matrix.mT).cos() @ matrix)


def test_a_jacobian_made_in_inference_mode_has_products_with_a_graph():
    with torch.inference_mode():
        J, dense = random_jacobian()
    v = normal(7, seed=1).requires_grad_()
    (gradient,) = torch.autograd.grad(J.matvec(v).sum(), v)
    torch.testing.assert_close(gradient, dense.clone().sum(0))


def test_the_largest_entries_of_rows():
    row, column = torch.tensor([0, 0, 0, 2, 0]), torch.tensor([4, 1, 3, 2, 1])
    index, used = largest(row, column, torch.tensor([1.0, 0.6, 2.0, 5.0, 0.6]), 3, 2)
    assert index[0].tolist() == [3, 1]  # 1 counts 0.6 twice
    assert used.tolist() == [[True, True], [False, False], [True, False]]
    assert index[2, 0] == 2


@pytest.mark.parametrize(("K", "least", "most"), [(16, 0.0, 0.7), (32, 0.8, 1.0), (48, 0.95, 1.0), (96, 0.99, 1.0)])
def test_recovery_against_the_number_of_samples(K, least, most):
    """3 of 300 parameters per output: about 2 s log(n / s) = 28 samples recover them."""
    A, u = sparse_map(100, 300, 3), normal(K, 300, seed=1)
    J = fit_sparse(u, u @ A.mT, torch.Size([100]), SparseSettings(8, prune=True))
    found, true = J.dense() != 0, A != 0
    recalled, false = float((found & true).sum() / true.sum()), float((found & ~true).sum() / found.sum().clamp_min(1))
    assert least <= recalled <= most
    assert false <= 0.15  # the rate is 0.1 on average
    if K >= 48:
        assert J.explained > 0.9
        assert float((J.dense() - A).norm() / A.norm()) < 0.25


def test_standard_errors_cover_the_truth_under_noise():
    """The share of entries within 2 standard errors; 0.95 of them for Student's t with 90 degrees of freedom."""
    A, u = sparse_map(400, 100, 2), normal(100, 100, seed=1)
    J = fit_sparse(u, u @ A.mT + 0.5 * normal(100, 400, seed=2), torch.Size([400]), SparseSettings(4, prune=True))
    truth = A.gather(1, J.index)
    real = J.found & (truth != 0)
    assert int(real.sum()) > 790  # of 800
    within = ((J.values - truth).abs() < 2 * J.standard_error)[real].double().mean()
    assert 0.91 < float(within) < 0.99
    # sd of a slope is 0.5 / sqrt(100)
    assert float(J.standard_error[real].mean()) == pytest.approx(0.05, rel=0.1)


def test_noise_alone_has_no_support():
    u = normal(40, 200)
    J = fit_sparse(u, normal(40, 300, seed=1), torch.Size([300]), SparseSettings(8))
    assert int(J.found.sum()) < 30  # of 60 000 pairs
    assert J.explained < 0.02
    assert bool(J.untouched.sum() > 170)


def test_a_dense_map_is_not_explained():
    """64 samples of 300 parameters: the least norm predicts about 48/300 of a held-out change, the sparse fit less.

    The same where samples come twice.
    """
    u, A = normal(64, 300), normal(200, 300, seed=1)
    J = fit_sparse(u, u @ A.mT, torch.Size([200]), SparseSettings(16))
    assert J.explained < 0.05
    assert J.explained_dense == pytest.approx(48 / 300, abs=0.06)
    u = u[:32].repeat(2, 1)
    J = fit_sparse(u, u @ A.mT, torch.Size([200]), SparseSettings(16))
    assert J.explained_dense == pytest.approx(24 / 300, abs=0.06)


def explained_by_least_norm(u, d, parts=4):
    """Share of the change of each fourth of the samples, or of some, that the others predict, by singular values."""
    rest, fold = torch.zeros(2).double(), torch.arange(len(u)) % 4
    for number in range(parts):
        kept, held = fold != number, fold == number
        v, e = u[held] - u[kept].mean(0), d[held] - d[kept].mean(0)
        U, s, V = torch.linalg.svd(u[kept] - u[kept].mean(0), full_matrices=False)
        inverse = s / (s.square() + 1e-6 * s.square().sum() / int(kept.sum()))
        slopes = V.mT @ (inverse[:, None] * (U.mT @ (d[kept] - d[kept].mean(0))))
        rest += torch.stack([(e - v @ slopes).square().sum(), e.square().sum()])
    return 1.0 - float(rest[0] / rest[1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("K", "n"), [(42, 40), (64, 40), (200, 40), (1000, 40), (64, 300)])
def test_a_dense_map_is_explained_as_singular_values_explain_it(dtype, K, n):
    """Fewer samples than parameters, more, and many more. In the last case each sample nearly repeats another one."""
    A, B, u = normal(n, 70) / n**0.5, normal(n, 70, seed=1) / n**0.5, normal(K, n, seed=2)
    if n > K:
        u[K // 2 :] = u[: K // 2] + 1e-3 * u[K // 2 :]
    u = u.float().double()
    d = (u @ A + 0.05 * u.square() @ B).float().double()
    J = fit_sparse(u.to(dtype), d.to(dtype), torch.Size([70]), SparseSettings(16))
    assert J.explained_dense == pytest.approx(explained_by_least_norm(u, d), abs=1e-4)


def test_a_dense_map_is_explained_also_where_slopes_are_known():
    """By two of the four parts. A search does not need it: it keeps the share that the first fit has measured."""
    A, u = normal(40, 70), normal(64, 40, seed=1)
    d = u @ A + 0.1 * normal(64, 70, seed=2)
    first = fit_sparse(u, d, torch.Size([70]), SparseSettings(16))
    again = fit_sparse(u, d, torch.Size([70]), SparseSettings(16, compared=True), first)
    assert again.explained_dense == pytest.approx(explained_by_least_norm(u, d, parts=2), abs=1e-4)
    kept = fit_sparse(u, d, torch.Size([70]), SparseSettings(16), first)
    assert 0.9 < kept.explained_dense == first.explained_dense != again.explained_dense


def test_held_out_samples_are_not_used():
    """The predicted share is measured on samples that the fit has not seen."""
    A, u, v = sparse_map(200, 300, 3), normal(80, 300, seed=1), normal(200, 300, seed=2)
    noise = 3.0 * normal(280, 200, seed=3)
    J = fit_sparse(u, u @ A.mT + noise[:80], torch.Size([200]), SparseSettings(8))
    assert J.explained == pytest.approx(explained_by(J, v, v @ A.mT + noise[80:]), abs=0.1)
    assert explained_by(J, u, u @ A.mT + noise[:80]) > J.explained + 0.15


def test_an_old_jacobian_is_support_and_prior():
    """8 new samples say little of a new map; with the old one, which is 10 % off, they determine it."""
    A, u = sparse_map(200, 300, 3), normal(40, 300, seed=1)
    settings = SparseSettings(6)
    old = fit_sparse(normal(100, 300, seed=4), normal(100, 300, seed=4) @ A.mT, torch.Size([200]), settings)
    few = u[:12]
    alone = fit_sparse(few, few @ (1.1 * A).mT, torch.Size([200]), settings)
    both = fit_sparse(few, few @ (1.1 * A).mT, torch.Size([200]), settings, old)
    assert float((alone.dense() - 1.1 * A).norm() / A.norm()) > 0.5
    assert float((both.dense() - 1.1 * A).norm() / A.norm()) < 0.1


def test_overlapping_footprints_and_neighbours():
    """A blur of 3x3: each pixel sees nine texels. Neighbours find with 40 samples what needs 100 without them."""
    side = 16
    eye = torch.eye(side**2).double().view(-1, 1, side, side)
    A = torch.nn.functional.avg_pool2d(eye, 3, 1, 1).view(side**2, -1).mT.contiguous()  # [pixels, texels]
    u = normal(40, side**2, seed=1)
    error = {}
    for grid in (None, (side, side, 1)):
        J = fit_sparse(u, u @ A.mT, torch.Size([side, side]), SparseSettings(12, grid=grid))
        error[grid is None] = float((J.dense().view(side**2, -1) - A).norm() / A.norm())
    assert error[False] < 0.3
    assert error[True] > 2 * error[False]


def test_pruning_keeps_the_rate_where_neighbours_share_evidence():
    """Neighbours propose texels beside the nine of a pixel; texels that are not significant are dropped."""
    side = 12
    eye = torch.eye(side**2).double().view(-1, 1, side, side)
    A = torch.nn.functional.avg_pool2d(eye, 3, 1, 1).view(side**2, -1).mT.contiguous()
    u, false = normal(60, side**2, seed=1), {}
    for prune in (False, True):
        settings = SparseSettings(16, grid=(side, side, 1), prune=prune)
        found = fit_sparse(u, u @ A.mT, torch.Size([side, side]), settings).dense().view(side**2, -1) != 0
        false[prune] = float((found & (A == 0)).sum() / found.sum())
    assert false[True] < 0.1 < false[False]


def test_fits_that_know_slopes_hold_out_fewer_parts(monkeypatch):
    """Each part that is held out takes as long as a fit."""
    held, count = sparse_fit.slopes_by_ridges, []
    monkeypatch.setattr(sparse_fit, "slopes_by_ridges", lambda *given: count.append(1) or held(*given))
    u, settings = normal(40, 20), SparseSettings(2)
    first = fit_sparse(u, u[:, :10], torch.Size([10]), settings)
    assert len(count) == 4
    again = fit_sparse(u, u[:, :10], torch.Size([10]), settings, first)
    assert len(count) == 6
    assert again.explained > 0.99


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_products_of_values_and_vectors_of_two_types(dtype):
    J = SparseJacobian(
        torch.tensor([[0, 3], [2, 0]]), vector(1.0, 2.0, 5.0, 0.0).view(2, 2), torch.zeros(2, 2), 4, torch.Size([2])
    )
    half = J.to(torch.zeros(1, dtype=dtype))
    for like in (torch.float32, torch.float64):
        assert half.matvec(torch.ones(4, dtype=like)).tolist() == [3.0, 5.0]
        assert half.rmatvec(torch.ones(2, dtype=like)).tolist() == [1.0, 0.0, 5.0, 2.0]


class Largest(TorchDispatchMode):
    """Keeps the most elements that a tensor has had."""

    elements = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        for one in tree_leaves(result):
            if isinstance(one, torch.Tensor):
                self.elements = max(self.elements, one.untyped_storage().nbytes() // one.element_size())
        return result


@pytest.mark.parametrize("compiled", [True, False])
def test_no_tensor_of_a_fit_has_as_many_elements_as_the_jacobian(compiled, monkeypatch):
    """The memory of a fit is a constant times the entries that it keeps, here 4 of 4 096 per pixel."""
    monkeypatch.setattr(extension, "available", compiled and extension.available)
    side, settings = 64, SparseSettings(4, grid=(64, 64, 1))
    u = normal(32, side**2).float()
    with Largest() as largest:
        J = fit_sparse(u, u, torch.Size([side, side]), settings)
        fit_sparse(u, u, torch.Size([side, side]), settings, J)
    assert J.explained > 0.9
    assert largest.elements <= side**4 / 16


def test_the_mean_over_neighbours():
    """Against a loop over the 3x3 pixels and the 3x3 parameters."""
    grids = Grids((4, 3, 2), (3, 2, 1))
    squares = normal(24, 6).square()
    whole, result = squares.view(4, 3, 2, 3, 2), grids.mean(squares).view(4, 3, 2, 3, 2)
    near = lambda k, size: slice(max(0, k - 1), min(size, k + 2))  # noqa: E731
    for r, c, h, w in [(0, 0, 0, 0), (1, 1, 1, 1), (3, 2, 2, 0), (2, 0, 1, 1)]:
        expected = whole[near(r, 4), near(c, 3), 1, near(h, 3), near(w, 2)]
        assert float(result[r, c, 1, h, w]) == pytest.approx(float(expected.mean()))


def test_thresholds_keep_the_rate():
    """Of 20 000 pairs with 100 true ones, those above the threshold are true but for about the rate."""
    A, u = torch.zeros(100, 200).double(), normal(60, 200, seed=1)
    A[torch.arange(100), torch.arange(100)] = 1.0
    d = u @ A.mT + 0.8 * normal(60, 100, seed=2)
    u, d = u - u.mean(0), d - d.mean(0)
    least = thresholds(u, d, Grids((100, 1, 1)), 0.1).own
    r = (d / d.norm(dim=0)).mT @ (u / u.norm(dim=0))
    found = r.square() >= least
    assert int(found[A != 0].sum()) > 95
    assert int(found[A == 0].sum()) < 25
    nothing = normal(60, 100, seed=3)
    nothing = nothing - nothing.mean(0)
    r = (nothing / nothing.norm(dim=0)).mT @ (u / u.norm(dim=0))
    assert thresholds(u, nothing, Grids((100, 1, 1)), 0.1).own > float(r.square().max())


def test_what_is_below_chance_never_counts_however_many_others_do():
    """Every pixel depends on all parameters, and nine in ten discoveries may be false. The mean by chance is 1 / 60."""
    u = normal(60, 4, seed=1)
    d = u @ normal(4, 100, seed=2) + normal(60, 100, seed=3)
    u, d = u - u.mean(0), d - d.mean(0)
    least = thresholds(u, d, Grids((10, 10, 1), (2, 2, 1)), 0.9)
    assert 4 / 60 <= least.own < 1.0
    assert 1.25 / 60 <= least.joint < 1.0


def test_thresholds_take_a_million_of_many_correlations(monkeypatch):
    """Of 2048 x 8192 pairs and as many decoys, a block of rows at a time."""
    sizes, histogram = [], sparse_selection._histogram
    monkeypatch.setattr(
        sparse_selection, "_histogram", lambda one, least: sizes.append(one.numel()) or histogram(one, least)
    )
    u, d = normal(9, 2048).float(), normal(9, 8192, seed=1).float()
    thresholds(u - u.mean(0), d - d.mean(0), Grids((8192, 1, 1)), 0.1)
    assert max(sizes) <= 1 << 20
    assert 1 << 20 <= sum(sizes) / 2 <= 2 << 20


def test_weights_are_those_of_least_squares():
    """Samples of weight 0 do not count."""
    A, u = sparse_map(50, 40, 2), normal(60, 40, seed=1)
    d, weights = u @ A.mT, torch.ones(60).double()
    d[::3] = 10 * normal(20, 50, seed=2)
    weights[::3] = 0.0
    J = fit_sparse(u, d, torch.Size([50]), SparseSettings(6), weights=weights)
    torch.testing.assert_close(J.dense(), A, atol=0.01, rtol=0)


def test_a_background_says_nothing_about_what_changes_before_it():
    """The held-out test, and the rates of false discoveries, are of rows of the image that change."""
    A, u = sparse_map(8 * 64, 100, 3), normal(60, 100, seed=1)
    image = torch.zeros(60, 64, 64, dtype=A.dtype)
    image[:, 20:28] = (u @ A.mT).view(60, 8, 64)
    found = fit_sparse(u, image.flatten(1), torch.Size([64, 64]), SparseSettings(8))
    assert found.explained > 0.9
    assert float((found.dense().view(64, 64, 100)[20:28].flatten(0, 1) - A).norm() / A.norm()) < 0.1


def test_parts_are_spaced_by_their_energy():
    energy = torch.tensor([0.0, 0.0, 1.0, 1.0, 2.0, 0.0])
    assert spaced(energy, 2) == [2, 4]
    assert spaced(energy, 4) == [2, 3, 4]
    assert spaced(energy, 6) == list(range(6))
    assert spaced(torch.zeros(6), 3) == [0, 2, 4]


def test_a_fit_takes_eight_samples():
    with pytest.raises(ValueError, match=r"samples must be at least 8 to fit 2 parameters per output \(keep\), got 7$"):
        check_samples(7, 2)
    check_samples(8, 2)
    with pytest.raises(ValueError, match="at least 12 "):
        check_samples(11, 10)


@pytest.mark.parametrize(("samples", "dropped", "keep"), [(8, 0, 6), (12, 3, 7)])
def test_fewer_samples_fit_fewer_parameters(samples, dropped, keep):
    """Six kept entries and a constant need eight samples; with the named number the samples are enough."""
    with pytest.raises(ValueError, match=rf"at least 18 .* or give keep={keep}, if no output depends on more"):
        check_samples(samples, 16, dropped)
    check_samples(samples, keep, dropped)


def test_held_out_elements_are_bands_of_four_rows():
    """Of an image of 100 x 300 that changes in rows 10 to 19 and 60 to 69: 4 bands of 4 rows, all of which change."""
    changes = torch.zeros(5, 100, 300, dtype=torch.float64)
    changes[:, 10:20] = changes[:, 60:70] = normal(5, 10, 300)
    part, grids = _subset(Grids((100, 300, 1)), changes.flatten(1))
    rows = (part.view(-1, 300)[:, 0] // 300).tolist()
    assert grids.pixels == (len(rows), 300, 1)
    assert len(rows) == 16
    assert all(sum(other in rows for other in range(one - 3, one + 4)) >= 4 for one in rows)
