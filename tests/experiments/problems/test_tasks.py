"""Fitting tasks: the black box, its start, its errors and its closed forms must be what the task says."""

from itertools import permutations

import numpy as np
import pytest
import torch
from skimage import data, draw

import torch_zerohess as zh
from experiments.problems import catalogue
from experiments.problems.task import Task
from experiments.problems.tasks import brdf, nonpsd
from experiments.studies.nonpsd import READINGS, nonpsd_error

NAMES = ("quad", "box2", "box10", "texture", "texture100", "texture317", "dense", "brdf", "nonpsd", "discs", "hexagon")
TASKS = {name: catalogue.load(name) for name in NAMES}
IMAGES = ("box2", "box10", "texture", "texture100", "texture317", "brdf", "discs", "hexagon")
TEXTURE = data.camera().reshape(32, 16, 32, 16).mean((1, 3)).ravel() / 255
CORNERS = np.exp(2j * np.pi * (np.arange(6) + 0.3) / 6)  # of a regular hexagon
SOLUTIONS = {
    "quad": [0.0, 0.0],
    "box2": [0.3, 0.3],
    "box10": [0.21, 0.21, 0.5, 0.5, 0.79, 0.79, 0.21, 0.79, 0.79, 0.21],
    "texture": TEXTURE,
    "texture100": data.camera()[6:506, 6:506].reshape(100, 5, 100, 5).mean((1, 3)).ravel() / 255,
    "texture317": data.camera()[97:414, 97:414].ravel() / 255,
    "dense": [k / 149.5 - 1 for k in range(300)],
    "brdf": [0.6, 0.25, 0.15, 0.5, 0.5, 0.4, 0.7],
    "nonpsd": [0.0, 0.0],
    "discs": [
        *(0.22, 0.25, 0.12, 0.5, 0.2, 0.08, 0.78, 0.24, 0.14),
        *(0.25, 0.72, 0.15, 0.55, 0.6, 0.1, 0.8, 0.75, 0.11),
    ],
    "hexagon": (0.55 + 0.5j + 0.32 * CORNERS).view(float),
}
STARTS = {
    "quad": ([800] * 2, [1000] * 2),
    "box2": ([0.43] * 2, [0.72] * 2),
    "box10": (
        [0.385, 0.385, 0.475, 0.475, 0.565, 0.565, 0.385, 0.565, 0.565, 0.385],
        [0.435, 0.435, 0.525, 0.525, 0.615, 0.615, 0.435, 0.615, 0.615, 0.435],
    ),
    "texture": ([0] * 1024, [1] * 1024),
    "texture100": ([0] * 10_000, [1] * 10_000),
    "texture317": ([0] * 317**2, [1] * 317**2),
    "dense": ([-2] * 300, [2] * 300),
    "brdf": ([0] * 7, [0.5] * 6 + [0.3]),
    "nonpsd": ([-3] * 2, [3] * 2),
    "discs": ([0.1, 0.1, 0.08] * 6, [0.9, 0.9, 0.14] * 6),
    "hexagon": tuple((0.4 + 0.5j + 0.15 * CORNERS).view(float) + spread for spread in (-0.06, 0.06)),
}


def vector(numbers) -> torch.Tensor:
    return torch.tensor(np.array(numbers), dtype=torch.float64)


@pytest.fixture(params=NAMES)
def name(request) -> str:
    return request.param


@pytest.fixture
def task(name) -> Task:
    return TASKS[name]


def starts(task: Task, count: int = 20) -> torch.Tensor:
    return torch.stack([task.start(run) for run in range(count)])


def test_every_task_says_what_it_is(task, name) -> None:
    assert (task.name, task.n) == (name, len(SOLUTIONS[name]))
    assert task.title
    assert task.parameters
    assert task.needs
    assert task.sigma > 0
    assert task.evaluations >= 20_000


def test_errors_vanish_at_the_solution_and_only_there(task) -> None:
    solution = vector(SOLUTIONS[task.name])
    assert task.truth.image_error(solution) == pytest.approx(0.0, abs=1e-30)
    assert task.truth.parameter_error(solution) == pytest.approx(0.0, abs=1e-30)
    for x in starts(task):
        assert task.truth.image_error(x) > 1e-4
        assert task.truth.parameter_error(x) > 1e-4
        assert task.truth.image_error(x) == pytest.approx(float(task.loss(x[None])[0] - task.loss(solution[None])[0]))


def test_starts_are_in_their_range_and_the_same_every_time(task) -> None:
    found = starts(task, 400 if task.n < 100 else 20)
    lower, upper = (vector(one) for one in STARTS[task.name])
    assert found.dtype == torch.float64
    assert bool(((found >= lower) & (found <= upper)).all())
    assert torch.equal(found[:20], starts(task))
    assert len({tuple(x.tolist()) for x in found}) == len(found)
    # They use all of the range: of 400 uniform numbers none in a tenth at one end has a probability of 5e-19.
    if task.n < 100:
        assert bool((found.min(0).values < lower + 0.1 * (upper - lower)).all())
        assert bool((found.max(0).values > upper - 0.1 * (upper - lower)).all())
    if task.bounds:
        assert bool(((found >= task.bounds[0]) & (found <= task.bounds[1])).all())
        assert bool((vector(SOLUTIONS[task.name]) >= task.bounds[0]).all())
        assert bool((vector(SOLUTIONS[task.name]) <= task.bounds[1]).all())


@pytest.mark.parametrize("name", IMAGES)
def test_image_and_loss_are_one_black_box(name) -> None:
    task, x = TASKS[name], starts(TASKS[name], 5)
    images, losses = task.output.image(x), task.loss(x)
    assert images.dtype == losses.dtype == torch.float64
    for image, loss in zip(images, losses, strict=True):
        assert float(task.output.loss(image)) == pytest.approx(float(loss), rel=1e-12)
        assert float(task.output.residuals(image).square().mean()) == pytest.approx(float(loss), rel=1e-12)
        assert task.output.residuals(image).dim() == 1
    assert torch.equal(torch.cat([task.loss(one[None]) for one in x]), losses)
    gradient = torch.func.grad(task.output.loss)(images[0])
    assert gradient.shape == images[0].shape
    assert bool(gradient.any())


@pytest.mark.parametrize("name", IMAGES)
def test_pictures_can_be_shown(name) -> None:
    task = TASKS[name]
    picture, target = task.picture.of(task.start(0)), task.picture.target()
    assert picture.shape == target.shape
    assert target.dim() == 2 or target.shape[2] == 3
    for one in (picture, target):
        assert 0 <= float(one.min()) < float(one.max()) <= 1
    torch.testing.assert_close(task.picture.of(vector(SOLUTIONS[name])), target)


def test_quad_is_the_quadratic() -> None:
    x = vector([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [900.0, -800.0]])
    assert TASKS["quad"].loss(x).tolist() == [5.0, 5.0, 17.5, 5 * 900**2 + 5 * 800**2 - 7.5 * 900 * 800]


def squares(x: np.ndarray, side: int) -> np.ndarray:
    """Soft squares over the whole image, from their definition."""
    pixel = (np.arange(side) + 0.5) / side
    image = np.zeros((side, side))
    for px, py in np.clip(x.reshape(-1, 2), 0.1, 0.9):
        powers = np.abs((pixel[:, None] - py) / 0.1) ** 10 + np.abs((pixel[None] - px) / 0.1) ** 10
        image += np.clip(1 - 2 * powers, 0, 1)
    return np.clip(image, 0, 1)


@pytest.mark.parametrize(
    ("name", "preset", "side"), [("box2", "fast", 128), ("box10", "fast", 64), ("box2", "paper", 500)]
)
def test_boxes_are_soft_squares(name, preset, side) -> None:
    task, target = catalogue.load(name, preset), squares(np.array(SOLUTIONS[name]), side)
    for x in (*starts(task, 2), 3 * task.start(2) - 1):  # squares of the last one are kept within the image
        image = squares(x.numpy(), side)
        torch.testing.assert_close(task.output.image(x[None])[0], torch.from_numpy(image))
        assert float(task.loss(x[None])[0]) == pytest.approx(np.mean((image - target) ** 2))


def test_box2_starts_on_a_plateau() -> None:
    task = TASKS["box2"]
    far = starts(task, 100)
    far = far[(far > 0.5).any(1)]  # 0.2 from the target, two half widths
    assert len(far) > 50
    # Two squares that do not overlap: the sum of their energies, but for where pixels sample the soft edge.
    losses = task.loss(far)
    energy = 2 * float(task.picture.target().square().mean())
    torch.testing.assert_close(losses, torch.full_like(losses, energy), rtol=0.02, atol=0)
    near = task.loss(vector([[0.3, 0.32], [0.3, 0.4]]))
    assert float(near[0]) < float(near[1]) < 0.9 * energy


def test_smoothing_gives_the_plateau_of_box2_a_slope() -> None:
    task = TASKS["box2"]
    x = vector([0.575, 0.575]).requires_grad_()
    zh.smooth(task.loss, zh.Smoothing(sigma=task.sigma, samples=2000, seed=0))(x).backward()
    assert bool((x.grad > 0).all())  # down is towards (0.3, 0.3)


def test_squares_of_box10_are_interchangeable() -> None:
    task, solution = TASKS["box10"], vector(SOLUTIONS["box10"]).view(5, 2)
    x = task.start(3).view(5, 2)
    expected = min(float((x[list(order)] - solution).square().mean()) for order in permutations(range(5)))
    for order in ([1, 0, 2, 3, 4], [4, 3, 1, 2, 0]):
        assert task.truth.parameter_error(x[order].flatten()) == pytest.approx(expected)
        assert task.truth.parameter_error(solution[order].flatten()) == 0.0
        assert task.truth.image_error(solution[order].flatten()) == pytest.approx(0.0, abs=1e-30)
    merged = solution[[0, 0, 2, 3, 4]].flatten()
    assert task.truth.parameter_error(merged) == pytest.approx(2 * 0.29**2 / 10)
    assert task.truth.image_error(merged) > 0.01


def test_discs_add_up_and_are_interchangeable() -> None:
    task, solution = TASKS["discs"], np.array(SOLUTIONS["discs"]).reshape(6, 3)
    pixel = (np.arange(64) + 0.5) / 64
    for x in (solution, task.start(0).view(6, 3).numpy(), np.tile([0.4, 0.6, 0.2], (6, 1))):
        inside = [(pixel[None] - px) ** 2 + (pixel[:, None] - py) ** 2 < r**2 for px, py, r in x]
        image = task.output.image(vector(x.ravel())[None])[0]
        torch.testing.assert_close(image, vector(0.5 * np.sum(inside, 0)))
    others = vector(solution[[3, 1, 5, 0, 2, 4]].ravel())
    assert task.truth.parameter_error(others) == 0.0
    assert task.truth.image_error(others) == 0.0
    moved = vector(np.where(np.arange(18) == 4, 0.3, others))  # y of the second disc, from 0.2
    assert task.truth.parameter_error(moved) == pytest.approx(0.1**2 / 18)


def test_hexagon_is_filled_and_its_corners_have_no_order() -> None:
    task, solution = TASKS["hexagon"], vector(SOLUTIONS["hexagon"]).view(6, 2)
    for x in (solution, task.start(0).view(6, 2)):
        expected = draw.polygon2mask((64, 64), x.flip(1).numpy() * 64 - 0.5)  # row, column of pixel centres
        image = task.output.image(x.flatten()[None])[0]
        assert image.unique().tolist() == [0, 1]
        assert float((image - vector(expected.astype(float))).abs().sum()) <= 2  # centres on an edge
    for order in (solution.roll(2, 0), solution.flip(0).roll(1, 0)):
        assert task.truth.parameter_error(order.flatten()) == pytest.approx(0.0, abs=1e-30)
    assert task.truth.parameter_error(solution[[1, 0, 2, 3, 4, 5]].flatten()) > 1e-3  # crosses itself


@pytest.mark.parametrize("name", ["discs", "hexagon"])
def test_hard_shapes_are_constant_almost_everywhere(name) -> None:
    x = starts(TASKS[name], 20)
    assert torch.equal(TASKS[name].loss(x), TASKS[name].loss(x + 1e-9))


def quadrature(task: Task, x: torch.Tensor, sigma: float, nodes: int = 60) -> float:
    """E f(x + sigma u) in two dimensions, from values of the black box."""
    u, w = np.polynomial.hermite_e.hermegauss(nodes)
    points = torch.cartesian_prod(vector(u), vector(u))
    return float(torch.outer(vector(w), vector(w)).flatten() @ task.loss(x + sigma * points)) / (2 * np.pi)


@pytest.mark.parametrize("name", ["quad", "nonpsd"])
@pytest.mark.parametrize("share", [0.2, 1.0])
def test_analytic_is_the_convolution(name, share) -> None:
    task = TASKS[name]
    for x in starts(task, 5):
        sigma = share * task.sigma
        assert float(task.truth.analytic(x, sigma)) == pytest.approx(quadrature(task, x, sigma), rel=1e-9)


@pytest.mark.parametrize("name", ["texture", "brdf"])
@pytest.mark.parametrize("share", [0.3, 1.0])
def test_analytic_is_the_mean_of_the_black_box(name, share) -> None:
    task, sigma = TASKS[name], share * TASKS[name].sigma
    x = task.start(0)
    u = torch.randn(4000, task.n, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    values = task.loss(x + sigma * u)
    # Five standard errors: a false alarm in 2e6.
    assert float(task.truth.analytic(x, sigma)) == pytest.approx(
        float(values.mean()), abs=5 * float(values.std()) / 4000**0.5
    )


@pytest.mark.parametrize("name", ["quad", "texture", "brdf", "nonpsd"])
def test_analytic_without_smoothing_is_the_loss(name) -> None:
    task = TASKS[name]
    x = task.start(1)
    assert float(task.truth.analytic(x, 0.0)) == pytest.approx(float(task.loss(x[None])[0]))
    gradient = torch.func.grad(task.truth.analytic)(x, 0.0)
    v = vector(np.cos(np.arange(task.n)))
    h = 1e-5 * task.sigma
    difference = (task.truth.analytic(x + h * v, 0.0) - task.truth.analytic(x - h * v, 0.0)) / (2 * h)
    assert float(gradient @ v) == pytest.approx(float(difference), rel=1e-5)


def test_brdf_is_indefinite_at_every_start_and_positive_definite_at_the_solution() -> None:
    hessian = torch.func.hessian(lambda x: TASKS["brdf"].loss(x[None])[0])
    for x in starts(TASKS["brdf"], 20):
        w = torch.linalg.eigvalsh(hessian(x))
        assert float(w[0]) < -1e-3
        assert float(w[-1]) > 1e-3
    assert float(torch.linalg.eigvalsh(hessian(vector(SOLUTIONS["brdf"])))[0]) > 1e-3


def test_brdf_is_a_lit_sphere() -> None:
    sphere = brdf.PhongSphere(65)  # odd: a pixel looks at the centre, whose normal is the view
    matte = sphere(vector([[1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5]]))[0]
    glossy = sphere(vector([[0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.5]]))[0]  # exponent 10
    light = np.array(brdf.LIGHT) - [0.0, 0.0, 1.0]
    distance = np.linalg.norm(light)
    nearest = min(np.linalg.norm(np.array(brdf.LIGHT) - point) for point in sphere_points(65))
    irradiance, cosine = (nearest / distance) ** 2, light[2] / distance
    # At the centre, normal and view are one direction, so mirrored light and view enclose the angle of the light.
    center = sphere.picture(matte)[32, 32].tolist()
    assert center == pytest.approx([irradiance * cosine, 0.5 * irradiance * cosine, 0.0])
    assert float(sphere.picture(glossy)[32, 32, 0]) == pytest.approx(irradiance * cosine**10)
    assert not bool(sphere.picture(matte)[0, 0].any())  # beside the sphere
    assert not bool(sphere.picture(matte)[55, 10].any())  # on the side away from the light
    assert not bool(sphere.picture(glossy)[55, 10].any())


def sphere_points(side: int) -> np.ndarray:
    axis = brdf.FRAME * (2 * (np.arange(side) + 0.5) / side - 1)
    x, y = (one.ravel() for one in np.meshgrid(axis, axis))
    inside = x**2 + y**2 < 1
    x, y = x[inside], y[inside]
    return np.stack([x, y, np.sqrt(1 - x**2 - y**2)], 1)


def test_nonpsd_starts_cover_the_square() -> None:
    found = starts(TASKS["nonpsd"], 400)
    axis = torch.linspace(-3, 3, 20, dtype=torch.float64).tolist()
    assert {tuple(x) for x in found.tolist()} == {(a, b) for a in axis for b in axis}
    assert bool((TASKS["nonpsd"].start(1000) != TASKS["nonpsd"].start(1001)).any())
    hessians = torch.func.vmap(torch.func.hessian(lambda x: TASKS["nonpsd"].loss(x[None])[0]))(found)
    assert torch.equal(torch.linalg.eigvalsh(hessians)[:, 0] < 0, found.norm(dim=1) > nonpsd.S1)
    truth = TASKS["nonpsd"].truth
    assert truth.parameter_error(vector([0.006, 0.008])) == pytest.approx(truth.precision)


def test_error_of_the_hessian_of_nonpsd(capsys) -> None:
    (error,) = nonpsd_error(samples=100, grid=31, widths=((1.0, 1.0),))[:1]
    assert error.evaluations == 100
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("Mean error within 0.0001 of 2 rows: signed in 2, squared in 2, absolute in 0. Relative")
    # Unbiased: the signed mean is noise. The mean of |error| is far from the claim, the mean of error^2 is not.
    assert error.signed < 5 * error.signed_noise
    assert error.squared < 1e-4 < error.absolute
    assert error.absolute**2 < error.squared
    assert [name for name in READINGS if getattr(error, name) > 0.01] == []
    with pytest.raises(SystemExit, match="samples must be even"):
        nonpsd_error(samples=99)
