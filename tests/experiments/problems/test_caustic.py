"""CAUSTIC: optics against closed forms and another implementation, the text, the method for it, and the path tracer."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from experiments.methods import METHODS
from experiments.problems import catalogue
from experiments.problems.scenes.caustic import INDEX, Caustic, basis, refraction
from experiments.problems.task import Task, Truth, least_squares
from experiments.problems.tasks import caustic
from experiments.runs.attempt import attempt
from experiments.runs.records import Files, read
from experiments.studies.caustic import check, check_caustic, correlation

PATCHES = 29
KNOTS = np.arange(-3, PATCHES + 4) / PATCHES
TASK = catalogue.load("caustic")


def quadratic(curvature: float) -> torch.Tensor:
    """Coefficients of -curvature/2 ((x - 1/2)^2 + (y - 1/2)^2): coefficients of t^2 are i^2 - 1/3 (polar form)."""
    one = (torch.arange(-1, 31).double() / PATCHES - 0.5) ** 2 - 1 / (3 * PATCHES**2)
    return (-0.5 * curvature * (one[:, None] + one)).flatten()


def prism(slope: float) -> torch.Tensor:
    """Coefficients of slope x."""
    return slope * (torch.arange(-1, 31).double() / PATCHES).repeat(32)


def waves(size: float, seed: int = 0) -> torch.Tensor:
    return size * torch.randn(1024, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_basis_is_that_of_scipy() -> None:
    places = torch.linspace(0, 1, 300, dtype=torch.float64)
    for count in (32, 64):
        spline = BSpline(np.arange(-3, count + 1) / (count - 3), np.eye(count), 3)
        np.testing.assert_allclose(basis(places, 0, count), spline(places.numpy()), atol=1e-13)
        np.testing.assert_allclose(basis(places, 1, count), spline.derivative()(places.numpy()), atol=1e-10)
    with pytest.raises(ValueError, match="derivative must be 0 or 1, got 2"):
        basis(places, 2)


@pytest.mark.parametrize("degrees", [0.1, 5.0, 20.0, 41.0])
def test_refraction_is_snells_law_in_angles(degrees) -> None:
    inside = math.radians(degrees)
    outside = math.asin(INDEX * math.sin(inside))
    slope = torch.tensor(math.tan(inside), dtype=torch.float64)
    assert float(slope * refraction(slope**2)) == pytest.approx(math.tan(outside - inside), rel=1e-9)


def test_nothing_leaves_beyond_the_critical_angle() -> None:
    critical = math.tan(math.asin(1 / INDEX))
    optics = Caustic(side=16, photons=32, distance=0.5)
    assert float(optics.image(prism(1.01 * critical)[None]).sum()) == 0.0
    assert float(Caustic(side=16, photons=32, distance=1e-6).image(prism(0.99 * critical)[None]).mean()) > 0.9


@pytest.mark.parametrize(("side", "photons"), [(64, 128), (16, 16), (10, 40)])
def test_flat_slab_is_uniform(side, photons) -> None:
    image = Caustic(side, photons).image(torch.stack([torch.zeros(1024), torch.full((1024,), 0.03)]))
    torch.testing.assert_close(image, torch.ones(2, side, side, dtype=torch.float64), rtol=1e-5, atol=0)


def test_prism_moves_all_light_as_snells_law_says() -> None:
    slope, optics = 0.1, Caustic(side=64, photons=32, distance=0.5)
    x, y = optics.landing(prism(slope))
    places = (np.arange(32) + 0.5) / 32
    inside = math.atan(slope)
    shift = math.tan(math.asin(INDEX * math.sin(inside)) - inside)
    expected = 64 * (places + shift * (0.5 - slope * places)) - 0.5
    np.testing.assert_allclose(x, np.tile(expected, (32, 1)), rtol=1e-5)
    np.testing.assert_allclose(y, np.tile((64 * places - 0.5)[:, None], 32), atol=1e-4)


def test_thin_lens_has_its_focal_length() -> None:
    radius = 10.0  # of curvature: focal length radius / (INDEX - 1) = 20, at slopes of a twentieth
    focal = radius / (INDEX - 1)
    for distance in (0.25 * focal, 0.5 * focal, focal):
        optics = Caustic(side=64, photons=64, distance=distance)
        x, y = ((one.double() + 0.5) / 64 - 0.5 for one in optics.landing(quadratic(1 / radius)))
        start = (torch.arange(64).double() + 0.5) / 64 - 0.5
        scale = 1 - distance / focal
        torch.testing.assert_close(x, scale * start.expand(64, 64), rtol=0, atol=0.005)
        torch.testing.assert_close(y, scale * start[:, None].expand(64, 64), rtol=0, atol=0.005)
    image = Caustic(side=64, photons=256, distance=0.5 * focal).image(quadratic(1 / radius)[None])[0]
    torch.testing.assert_close(image[18:46, 18:46].mean(), torch.tensor(4.0).double(), rtol=0.02, atol=0)
    assert float(image.mean()) == pytest.approx(1.0, rel=1e-5)
    assert float(image[:14].sum() + image[:, -14:].sum()) == 0.0


def test_all_light_on_the_screen_is_counted() -> None:
    optics = Caustic(side=32, photons=64, distance=2.0)
    for size in (1e-4, 3e-3):
        x, y = optics.landing(waves(size))
        inside = (x >= -0.5) & (x <= 31.5) & (y >= -0.5) & (y <= 31.5)
        image = optics.image(waves(size)[None])[0]
        assert float(image.mean()) == pytest.approx(float(inside.double().mean()), rel=1e-5)
        assert float(image.min()) >= -1e-5
    assert 0.5 < float(inside.double().mean()) < 0.999


def test_image_is_that_of_photons_traced_one_by_one() -> None:
    side, photons, distance, c = 12, 24, 1.5, waves(2e-3)
    spline, places = c.view(32, 32).numpy(), (np.arange(photons) + 0.5) / photons
    value, slope = BSpline(KNOTS, np.eye(32), 3)(places), BSpline(KNOTS, np.eye(32), 3).derivative()(places)
    image = np.zeros((side, side))
    for i in range(photons):
        for j in range(photons):
            h = value[i] @ spline @ value[j]
            normal = np.array([-(value[i] @ spline @ slope[j]), -(slope[i] @ spline @ value[j]), 1.0])
            normal /= np.linalg.norm(normal)
            along = np.array([0.0, 0.0, 1.0])
            tangent = INDEX * (along - (along @ normal) * normal)
            out = tangent + math.sqrt(1 - tangent @ tangent) * normal
            at = np.array([places[j], places[i]]) + (distance - h) / out[2] * out[:2]
            if ((at < 0) | (at > 1)).any():
                continue
            for row in range(side):
                for column in range(side):
                    # A tent of the width of a pixel around the centre; its part beside the screen stays in the border.
                    x = np.clip(at * side - 0.5, 0, side - 1)
                    tent = np.maximum(0, 1 - np.abs(x - (column, row)))
                    image[row, column] += tent.prod() * (side / photons) ** 2
    found = Caustic(side, photons, distance).image(c[None])[0]
    assert image.std() > 0.1
    np.testing.assert_allclose(found, image, atol=2e-3)


def test_settings_are_checked() -> None:
    with pytest.raises(ValueError, match="distance must be positive and finite, got 0"):
        Caustic(distance=0.0)


@pytest.mark.parametrize("side", [64, 100])
def test_target_is_a_text_with_all_of_the_light(side) -> None:
    target = caustic.text(side)
    assert target.shape == (side, side)
    assert float(target.mean()) == pytest.approx(1.0)
    assert float(target.min()) == pytest.approx(caustic.BACKGROUND, rel=1e-3)
    assert torch.equal(target, caustic.text(side))

    def at(x: float, y: float) -> float:
        return float(target[int(y * side), int(x * side)])

    letter, between = 1.5, 0.6
    assert at(0.82, 0.26) < between  # within the O, whose stroke is left and right of it
    assert min(at(0.745, 0.26), at(0.895, 0.26)) > letter
    assert at(0.17, 0.735) > letter  # the bar of the H, dark above and below
    assert max(at(0.17, 0.6), at(0.17, 0.87)) < between
    assert max(at(0.5, 0.5), at(0.5, 0.02), at(0.02, 0.5)) < between


def test_task_is_the_image_of_the_slab_against_the_text() -> None:
    x = torch.stack([TASK.start(0), TASK.start(1), waves(3.0)])
    images, target = TASK.output.image(x), caustic.text(64)
    assert images.dtype == torch.float64
    expected = (images - target).square().mean((1, 2))
    torch.testing.assert_close(TASK.loss(x), expected)
    for image, one, error in zip(images, x, expected.tolist(), strict=True):
        assert float(TASK.output.loss(image)) == pytest.approx(error)
        assert float(TASK.output.residuals(image).square().mean()) == pytest.approx(error)
        assert TASK.truth.image_error(one) == pytest.approx(error)
        assert TASK.picture.of(one).shape == TASK.picture.target().shape
    assert torch.equal(torch.cat([TASK.loss(one[None]) for one in x]), TASK.loss(x))
    torch.testing.assert_close(
        Caustic(64, 128, 2.0).image(1e-3 * x), images
    )  # the unit is a thousandth of the slab's side


def test_starts_are_nearly_flat_and_within_the_bounds() -> None:
    starts = torch.stack([TASK.start(run) for run in range(20)])
    assert starts.std() == pytest.approx(0.3, rel=0.03)  # six standard errors of 20 480 numbers
    assert torch.equal(starts[3], TASK.start(3))
    assert bool((starts > TASK.bounds[0]).all() & (starts < TASK.bounds[1]).all())
    assert len({tuple(one.tolist()) for one in starts}) == 20


def test_smoothing_is_a_blur_of_a_pixel() -> None:
    """Where the docstring says that random coefficients of standard deviation 1 move light by about a pixel."""
    optics = Caustic(64, 128, caustic.DISTANCE, caustic.UNIT)
    moved = [optics.landing(one)[0] - optics.landing(0 * one)[0] for one in (waves(1.0, seed) for seed in range(4))]
    assert 0.7 < float(torch.stack(moved).std()) < 1.4


def test_more_coefficients_have_the_same_blur_in_smaller_pixels() -> None:
    task = catalogue.load("caustic64")
    x, target = torch.stack([task.start(0), 0 * task.start(0)]), caustic.text(128)
    optics = Caustic(128, 256, caustic.DISTANCE, 0.25 * caustic.UNIT, 64)
    torch.testing.assert_close(task.loss(x), (optics.image(x) - target).square().mean((1, 2)))
    assert float(task.loss(x)[1]) == pytest.approx(float((1 - target).square().mean()), rel=1e-4)
    generator = torch.Generator().manual_seed(0)
    random = torch.randn(4, 4096, generator=generator, dtype=torch.float64)
    moved = [optics.landing(one)[0] - optics.landing(0 * one)[0] for one in random]
    assert 0.7 < float(torch.stack(moved).std()) < 1.4


def test_there_is_no_parameter_error(tmp_path) -> None:
    outcome = attempt(TASK, "none", 0, lambda trial: trial.report(trial.start), tmp_path)
    rows = list(read(Files(tmp_path / "caustic" / "none", 0).log))
    assert [row.parameter_error for row in rows] == [None, None]
    assert outcome.status == "stopped"
    assert rows[0].image_error > 0.5


def linear(n: int, m: int) -> tuple[Task, torch.Tensor]:
    """A task of linear residuals, and its solution by least squares."""
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(m, n, generator=generator, dtype=torch.float64)
    b = torch.randn(m, generator=generator, dtype=torch.float64)
    best = torch.linalg.lstsq(a, b).solution
    lowest = float((a @ best - b).square().mean())
    task = replace(
        TASK,
        name="linear",
        n=n,
        output=least_squares(lambda x: x @ a.T, lambda image: image - b),
        start=lambda run: torch.zeros(n).double(),
        sigma=1.0,
        bounds=None,
        truth=Truth(lambda x: float((a @ x - b).square().mean()) - lowest, lambda x: float((x - best).square().mean())),
    )
    return task, best


def test_gauss_newton_solves_least_squares() -> None:
    method = METHODS["block_gauss_newton"]
    task, best = linear(120, 300)
    outcome = attempt(task, "block_gauss_newton", 0, lambda trial: method.solve(trial, None))
    assert outcome.status == "finished"
    assert outcome.evaluations < 120 + 5 * (30 + 7)  # a Jacobian, and a few steps
    np.testing.assert_allclose(outcome.x, best, atol=0.05 * float(best.abs().max()))


def test_gauss_newton_bends_the_light_within_one_jacobian() -> None:
    method = METHODS["block_gauss_newton"]
    assert method.applies(TASK) is None
    assert "100 parameters" in method.applies(catalogue.load("box10"))
    task = replace(TASK, evaluations=1 + 1024 + 6)
    outcome = attempt(task, "block_gauss_newton", 1000, lambda trial: method.solve(trial, None))
    assert outcome.evaluations == 1031
    error = task.truth.image_error
    assert error(torch.tensor(outcome.x).double()) < 0.6 * error(task.start(1000))


def test_particle_tracer_sees_the_same_light() -> None:
    flat = check(torch.zeros(1024), side=16, spp=100)
    assert flat.mean() == pytest.approx(1.0, abs=5 / math.sqrt(100 * 16**2))
    # x and y are not exchanged or mirrored. The light is as in the splat: a quarter of it leaves to one side.
    x = 1e3 * (prism(0.1) + 0.5 * prism(0.1).view(32, 32).T.flatten()) + waves(3.0)
    x = (x - x.mean()).clamp(-caustic.LARGEST, caustic.LARGEST)
    splat = Caustic(16, 128, caustic.DISTANCE, caustic.UNIT).image(x[None])[0]
    rendered = torch.from_numpy(check(x, side=16, spp=400))
    assert float(splat.std()) > 0.3
    assert correlation(splat, rendered) > 0.97
    assert float(rendered.mean()) == pytest.approx(float(splat.mean()), rel=0.03)


def test_check_reads_a_run(tmp_path, capsys) -> None:
    x = 1e3 * quadratic(0.1)
    attempt(TASK, "local", 0, lambda trial: trial.report(x), tmp_path)
    same = check_caustic(tmp_path, spp=20)
    assert f"particle tracer {same:.4f}" in capsys.readouterr().out
    assert same > 0.5
    assert (tmp_path / "caustic-local-0.png").stat().st_size > 1000
    with pytest.raises(SystemExit, match="run 5 of local on caustic"):
        check_caustic(tmp_path, run=5)
