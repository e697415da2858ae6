"""The door `zh.sparse_jacobian`: its samples, units and errors, on maps whose smoothed Jacobian is known.

Random tests have fixed seeds.
"""

import math

import pytest
import torch

import torch_zerohess as zh
from truths import normal

SIDE = 10
N = SIDE**2
SCALES = 1.0 + torch.arange(N).double() / N


def scaled(z):
    """Pixels [10, 10] of one texel each; the slope of pixel k is 1 + k / 100."""
    return (z * SCALES.to(z)).view(-1, SIDE, SIDE)


def smoothing(samples=30, **settings):
    return zh.Smoothing(**({"sigma": 0.1, "samples": samples, "seed": 0} | settings))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("antithetic", [True, False])
@pytest.mark.parametrize("proposal", ["aggregate", "gaussian"])
@pytest.mark.parametrize("sampler", ["random", "orthogonal"])
def test_slopes_in_units_of_the_parameters(dtype, antithetic, proposal, sampler):
    sigma = 0.05 + 0.1 * torch.rand(N, generator=torch.Generator().manual_seed(1)).double()
    settings = smoothing(sigma=sigma, antithetic=antithetic, proposal=proposal, sampler=sampler)
    J = zh.sparse_jacobian(scaled, normal(N).to(dtype), settings, keep=8)
    assert J.values.dtype == dtype
    assert J.evaluations == (60 if antithetic else 30)
    assert J.explained > 0.99
    torch.testing.assert_close(J.dense().view(N, N).double(), torch.diag(SCALES), atol=3e-3, rtol=0)


def test_a_step_has_the_slope_of_its_convolution():
    """Pixels that are 1 where their texel is above 0: at x = 0 the smoothed slope is 1 / (sigma sqrt(2 pi))."""
    J = zh.sparse_jacobian(lambda z: (z > 0).double().view(-1, SIDE, SIDE), torch.zeros(N).double(), smoothing(300))
    slopes, errors = J.dense().view(N, N).diagonal(), J.standard_error[J.found]
    truth = 1 / (0.1 * math.sqrt(2 * math.pi))
    assert bool((slopes > 0).all())
    assert float((slopes.mean() - truth).abs()) < 5 * float(slopes.std()) / math.sqrt(N) + 0.02 * truth
    assert float(slopes.std()) == pytest.approx(float(errors.max()), rel=0.5)


def sines(z):
    return torch.sin(2 * z)


def noisy(z, spread=0.0):
    """Each output is its parameter and noise, whose standard deviation may grow with the perturbation."""
    return z + (0.2 + spread * z.square()) * normal(*z.shape, seed=int(1e6 * z[0, 0].abs()))


@pytest.mark.parametrize(
    ("fn", "slope", "samples", "antithetic"),
    [
        (sines, 2 * math.exp(-0.5), 100, True),
        (sines, 2 * math.exp(-0.5), 400, False),
        (noisy, 1.0, 100, False),
        (noisy, 1.0, 400, True),
        (lambda z: noisy(z, 1.0), 1.0, 400, True),
    ],
)
def test_intervals_cover_the_slope(fn, slope, samples, antithetic):
    """400 slopes: the standard errors of the shares are 2.3 % and 1.1 %, and the limits 3 and 3.6 of them."""
    scores = []
    for seed in range(20):
        settings = zh.Smoothing(sigma=0.5, samples=samples, antithetic=antithetic, seed=seed)
        J = zh.sparse_jacobian(fn, torch.zeros(20).double(), settings, keep=1)
        assert J.index[:, 0].tolist() == list(range(20))
        scores.append((J.values - slope) / J.standard_error)
    within = lambda limit: float((torch.cat(scores).abs() < limit).double().mean())  # noqa: E731
    assert within(1.0) == pytest.approx(0.683, abs=0.07)
    assert within(1.96) == pytest.approx(0.95, abs=0.04)


@pytest.mark.filterwarnings("ignore:proposal 'uniform'")
@pytest.mark.parametrize(
    ("n", "samples", "keep", "least"), [(60, 400, 1, 8), (60, 400, 16, 18), (10, 400, 4, 8), (3, 20, 1, 8)]
)
def test_uniform_samples_of_which_few_count_are_refused(n, samples, keep, least):
    x, settings = torch.zeros(n).double(), zh.Smoothing(sigma=0.5, samples=samples, proposal="uniform", seed=0)
    with pytest.raises(
        ValueError,
        match=rf"proposal 'uniform' leaves an effective sample size of \d(\.\d+)? of {samples} samples, .* and {keep} "
        rf"parameters per output \(keep\) need {least}: use proposal 'gaussian'",
    ):
        zh.sparse_jacobian(lambda z: torch.cat([sines(z), z], 1), x, settings, keep=keep)
    for proposal in ("gaussian", "aggregate"):
        zh.sparse_jacobian(lambda z: torch.cat([sines(z), z], 1), x, settings.replace(proposal=proposal), keep=keep)


@pytest.mark.parametrize("seed", range(5))
def test_the_fewest_samples_are_enough_with_weights_that_differ_little(seed):
    """Of the 8 samples of "aggregate" that one parameter needs, 6 or 7 count."""
    J = zh.sparse_jacobian(lambda z: z.repeat(1, 40), torch.zeros(1).double(), smoothing(8, seed=seed))
    assert J.explained > 0.99


def test_uniform_samples_are_as_significant_as_those_that_count():
    """In 4 dimensions 15 to 100 of 1000 samples count, and correlations by chance are those of so few."""
    x, false = torch.zeros(4).double(), 0
    for seed in range(20):
        settings = zh.Smoothing(sigma=0.5, samples=1000, proposal="uniform", seed=seed)
        slopes = zh.sparse_jacobian(lambda z: sines(z).repeat(1, 4), x, settings, keep=4).dense()
        false += int((slopes != 0).sum()) - int((slopes.view(4, 4, 4).diagonal(dim1=1, dim2=2) != 0).sum())
    assert false <= 10  # of 960
    assert int((slopes != 0).sum()) >= 16


def test_an_earlier_jacobian_helps_and_is_in_the_same_units():
    before = zh.sparse_jacobian(scaled, torch.zeros(N).double(), smoothing(60))
    f = lambda z: 1.05 * scaled(z) + 0.3 * normal(len(z), SIDE, SIDE, seed=len(z)) * 0.1  # noqa: E731
    alone = zh.sparse_jacobian(f, torch.zeros(N).double(), smoothing(18, seed=1))
    both = zh.sparse_jacobian(f, torch.zeros(N).double(), smoothing(18, seed=1, sigma=0.2), previous=before)
    truth = torch.diag(1.05 * SCALES)
    assert float((both.dense().view(N, N) - truth).norm()) < 0.7 * float((alone.dense().view(N, N) - truth).norm())


def test_an_earlier_jacobian_is_not_fitted_to_its_own_samples_again():
    seen = []

    def seeing(z):
        seen.append(z)
        return scaled(z)

    x = torch.zeros(N).double()
    first = zh.sparse_jacobian(seeing, x, smoothing())
    second = zh.sparse_jacobian(seeing, x, smoothing(), previous=first)
    for _ in range(2):
        zh.sparse_jacobian(seeing, x, smoothing(), previous=second)
    zh.sparse_jacobian(seeing, x, smoothing())
    assert (first.total_evaluations, second.total_evaluations, second.evaluations) == (60, 120, 60)
    assert torch.equal(seen[0], seen[4])  # a seed gives the same bits
    assert torch.equal(seen[2], seen[3])
    for k, other in ((0, 1), (0, 2), (1, 2)):
        assert float((seen[k][:, None] - seen[other]).abs().amax(2).min()) > 0.0


def test_a_dense_map_is_noticed_also_by_later_jacobians():
    """80 outputs of all 100 parameters. Three quarters of 40 or 80 samples predict 30 or 60 % of the others."""
    A, x = normal(80, N, seed=1) / 10, torch.zeros(N).double()
    with pytest.warns(UserWarning, match="many parameters"):
        first = zh.sparse_jacobian(lambda z: z @ A.mT, x, smoothing(40))
    with pytest.warns(UserWarning, match="many parameters"):
        later = zh.sparse_jacobian(lambda z: z @ A.mT, x, smoothing(80), previous=first)
    for J, share in ((first, 0.3), (later, 0.6)):
        assert J.explained < 0.1
        assert J.explained_dense == pytest.approx(share, abs=0.1)


@pytest.mark.parametrize(("n", "samples", "order"), [(60, 512, 1), (30, 300, 2), (3, 40, 1), (1, 40, 2)])
def test_automatic_samples_keep_the_rate_where_others_are_sobol_points(n, samples, order):
    """Each output depends on one parameter. Of 60 parameters 1 to 7 % of the entries are false, with Sobol points 15 %.

    With hundreds of samples the standard errors are right. With Sobol points they are up to twice as large.
    """
    settings = zh.Smoothing.auto(sigma=0.5, samples=samples, order=order)
    assert settings.resolved(n).sampler == "sobol"
    own, every, scores = 0, 0, []
    for seed in range(4):
        J = zh.sparse_jacobian(
            lambda z: (z + 0.5 * z**3).repeat(1, 2), torch.zeros(n).double(), settings.replace(seed=seed)
        )
        true = J.found & (J.index == torch.arange(n).repeat(2)[:, None])
        own, every = own + int(true.sum()), every + int(J.found.sum())
        scores.append(((J.values - 1.375) / J.standard_error)[true])
    assert own == 8 * n
    assert every - own <= 0.1 * every
    if samples > 100:
        assert float(torch.cat(scores).std()) == pytest.approx(1.0, abs=0.2)


def test_pixels_that_are_not_finite():
    def hole(z):
        return torch.where((z[:, :1] > 0.2)[:, :, None], math.nan, scaled(z))

    with pytest.raises(ValueError, match="fn returned nan at the point"):
        zh.sparse_jacobian(hole, torch.zeros(N).double(), smoothing(100))
    J = zh.sparse_jacobian(hole, torch.zeros(N).double(), smoothing(100), on_nonfinite="drop")
    torch.testing.assert_close(J.dense().view(N, N), torch.diag(SCALES), atol=3e-3, rtol=0)


def test_an_error_names_the_samples_that_were_dropped():
    def failing(z):
        return torch.where(z[:, :1, None] > 0.01, math.nan, scaled(z))

    given = smoothing(20, antithetic=False)
    with pytest.raises(ValueError, match=r"at least 18 to fit 16 .*, got 20, of which \d were dropped because their"):
        zh.sparse_jacobian(failing, torch.zeros(N).double(), given, on_nonfinite="drop")


def test_neighbours_share_evidence_in_every_layout_of_images():
    """Two blurred images of 16x16 in three colours, whose pixels depend on nine texels."""

    def colours(z):
        blurred = torch.nn.functional.avg_pool2d(z.view(-1, 2, 16, 16), 3, 1, 1)
        return torch.stack([blurred, 0.5 * blurred, -blurred], -1)  # [K, 2, 16, 16, 3]

    def explained(fn):
        return zh.sparse_jacobian(fn, torch.zeros(512).double(), smoothing(40), keep=12, grid=(32, 16)).explained

    alone = explained(lambda z: colours(z).flatten(1))
    for dims in ((0, 1, 2, 3), (0, 3, 1, 2), (3, 0, 1, 2)):
        assert explained(lambda z, dims=dims: colours(z).permute(0, *(1 + one for one in dims))) > alone + 0.3


def test_one_point_at_a_time():
    J = zh.sparse_jacobian(lambda z: scaled(z)[0], torch.zeros(N).double(), smoothing(), vectorized=False)
    assert J.shape == (SIDE, SIDE)
    torch.testing.assert_close(J.dense().view(N, N), torch.diag(SCALES), atol=3e-3, rtol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fn": lambda z: z.sum(1)}, r"an output of many numbers, .* got shape \[\]: for one number use estimate"),
        ({"x": torch.zeros(2, N)}, r"x must be one point \[n\], got \[2, 100\]"),
        ({"smoothing": smoothing(12)}, r"samples must be at least 18 to fit 16 parameters per output \(keep\), got 12"),
        ({"smoothing": smoothing(proposal="fr22", order=1)}, "proposal must be .* got 'fr22'"),
        ({"smoothing": smoothing(sampler="sobol")}, "sampler must be 'random', 'orthogonal' or 'auto', got 'sobol'"),
        ({"keep": 101}, "keep must be between 1 and the number of parameters, 100, got 101"),
        ({"grid": (5, 5)}, r"grid must be rows and columns \(and channels\) of 100 parameters, got \(5, 5\)"),
        (
            {"previous": zh.sparse_jacobian(lambda z: z[:, :50], torch.zeros(N), smoothing())},
            r"previous must be a Jacobian of outputs \[10, 10\] of 100 parameters, got one of outputs \[50\] of 100",
        ),
    ],
)
def test_errors_name_what_is_wrong(changes, message):
    given = {"fn": scaled, "x": torch.zeros(N), "smoothing": smoothing()} | changes
    with pytest.raises(ValueError, match=message):
        zh.sparse_jacobian(given.pop("fn"), given.pop("x"), given.pop("smoothing"), **given)
    with pytest.raises(TypeError, match="smoothing must be a Smoothing, got float"):
        zh.sparse_jacobian(scaled, torch.zeros(N), 0.1)
    with pytest.raises(TypeError, match="previous must be a SparseJacobian, got Tensor"):
        zh.sparse_jacobian(scaled, torch.zeros(N), smoothing(), previous=torch.eye(N))
    for grid in (100, (10.0, 10)):
        with pytest.raises(TypeError, match=r"grid must be rows and columns .*, two or three integers, got"):
            zh.sparse_jacobian(scaled, torch.zeros(N), smoothing(), grid=grid)


@pytest.mark.parametrize("size", [1e-30, 1e25])
def test_outputs_of_any_size(size):
    """Squares of such numbers are 0 or infinite in float32; an earlier Jacobian of that size is of use."""
    x = torch.zeros(N)
    first = zh.sparse_jacobian(lambda z: size * scaled(z), x, smoothing(), keep=8)
    second = zh.sparse_jacobian(lambda z: size * scaled(z), x, smoothing(seed=1), keep=8, previous=first)
    for J in (first, second):
        assert J.explained > 0.99
        torch.testing.assert_close(J.dense().view(N, N) / size, torch.diag(SCALES).float(), atol=3e-3, rtol=0)


def test_fewer_parameters_than_an_output_may_have():
    """40 outputs of 5 parameters: unless `keep` is said, each may depend on all of them."""
    A = normal(40, 5).sign() + normal(40, 5, seed=1) / 10
    J = zh.sparse_jacobian(lambda z: z @ A.to(z).mT, torch.zeros(5).double(), smoothing(100))
    torch.testing.assert_close(J.dense(), A, atol=3e-3, rtol=0)


@pytest.mark.parametrize("m", [2, 9])
def test_outputs_of_few_numbers(m):
    J = zh.sparse_jacobian(lambda z: z[:, :m], torch.zeros(150).double(), zh.Smoothing(sigma=1.0, samples=100, seed=0))
    torch.testing.assert_close(J.dense(), torch.eye(m, 150).double(), atol=1e-3, rtol=0.0)
    assert J.explained > 0.999
    assert torch.equal(J.untouched, torch.arange(150) >= m)


DENSE = normal(20, N, seed=5)
WIDE = torch.exp(-torch.arange(-7, 8).double().square() / 18)


def wide(z):
    """Pixels [16, 16] that are means of 15x15 of 30x30 texels."""
    kernel = WIDE[:, None] * WIDE / WIDE.sum() ** 2
    return torch.nn.functional.conv2d(z.view(-1, 1, 30, 30), kernel[None, None])[:, 0]


def narrow(z):
    """Pixels [28, 28] that are means of 3x3 of 30x30 texels."""
    return torch.nn.functional.avg_pool2d(z.view(-1, 30, 30), 3, 1)


@pytest.mark.parametrize(
    ("fn", "n", "samples", "grid"),
    [
        pytest.param(lambda z: z @ DENSE.T, N, 40, None, id="dense, few samples"),
        pytest.param(lambda z: z @ DENSE.T, N, 150, None, id="dense, more samples than parameters"),
        pytest.param(wide, 900, 60, (30, 30), id="a wide blur"),
        pytest.param(narrow, 900, 20, (30, 30), id="too few samples"),
        pytest.param(lambda z: normal(len(z), 10, 10, seed=int(1e9 * z.abs().max())), N, 40, None, id="only noise"),
    ],
)
def test_a_useless_jacobian_is_a_warning(fn, n, samples, grid):
    """The first three have errors of 88 to 100 % of their length; the dense one with 150 samples is determined."""
    with pytest.warns(UserWarning, match=r"explained = 0\.\d\d of the changes") as noted:
        J = zh.sparse_jacobian(fn, torch.zeros(n).double(), smoothing(samples), grid=grid)
    assert noted[0].filename == __file__
    assert J.explained < max(0.05, 0.5 * J.explained_dense)


@pytest.mark.parametrize(
    ("fn", "n", "grid"),
    [
        pytest.param(scaled, N, None, id="one parameter each"),
        pytest.param(narrow, 900, (30, 30), id="a narrow blur"),
        pytest.param(lambda z: noisy(z) * 0.5, N, None, id="noise"),
        pytest.param(lambda z: z[:, :4] + 0.1 * normal(len(z), 4, seed=1), 4, None, id="noise, few parameters"),
        pytest.param(lambda z: z @ DENSE[:, :20].T, 20, None, id="most of 20 entries are found"),
        pytest.param(lambda z: torch.ones(len(z), 5).double(), N, None, id="constant"),
        pytest.param(lambda z: 1.0 + 1e-9 * z @ DENSE.T, N, None, id="constant but for rounding"),
        pytest.param(lambda z: z.square().view(-1, SIDE, SIDE), N, None, id="even"),
    ],
)
def test_no_warning_where_it_is_right_or_nothing_changes(fn, n, grid):
    zh.sparse_jacobian(fn, torch.zeros(n).double(), smoothing(60), grid=grid)  # a warning is an error
