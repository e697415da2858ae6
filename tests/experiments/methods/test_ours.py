"""Our searches as methods: which engine they ask, from what, and where they apply."""

from dataclasses import replace

import pytest
import torch
from small import TARGET, TASK

import torch_zerohess as zh
from experiments.methods import METHODS
from experiments.methods.settings import settings
from experiments.problems import catalogue
from experiments.runs.trial import Trial

BOX = TARGET - 6.0, TARGET + 6.0
BOUNDED = replace(TASK, bounds=BOX, evaluations=12)
ENGINES = {"gaussian_process": zh.optim.GaussianProcessSearch, "descent": zh.optim.Descent}


def points_of(task, name, settings=None):
    """Points [K, n] that a method evaluates, and whether it sees their images."""
    seen, images = [], []

    def loss(x):
        seen.append(x)
        return task.loss(x)

    def image(x):
        seen.append(x)
        images.append(x)
        return task.output.image(x)

    trial = Trial(replace(task, loss=loss, output=replace(task.output, image=image)), name, 3)
    with pytest.raises(Exception, match=r"evaluations used up|both errors reduced"):
        METHODS[name](trial, settings)
    return torch.cat(seen), bool(images)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("output", [True, False])
@pytest.mark.parametrize("sigma", [None, 0.3])
def test_a_method_asks_its_engine(engine, output, sigma):
    """The points equal the points of the engine alone, with sigma, bounds and seed of the trial."""
    name = engine if output else f"{engine}_loss"
    found, images = points_of(BOUNDED, name, None if sigma is None else {"sigma": sigma})
    assert images == output
    trial = Trial(BOUNDED, name, 3)
    search = ENGINES[engine](
        trial.start,
        sigma=sigma or TASK.sigma,
        bounds=BOX,
        loss=TASK.output.loss if output else None,
        restarts=BOUNDED.evaluations,
        seed=trial.seed,
    )
    expected = torch.empty(0, 2, dtype=torch.float64)
    while len(expected) < len(found):
        z = search.ask(limit=BOUNDED.evaluations - len(expected))
        expected = torch.cat([expected, z])
        search.tell(TASK.output.image(z) if output else TASK.loss(z))
    torch.testing.assert_close(found, expected[: len(found)], rtol=0, atol=0)


@pytest.mark.parametrize("name", ["gaussian_process", "gaussian_process_loss"])
def test_a_gaussian_process_needs_a_small_finite_box(name):
    method = METHODS[name]
    assert method.unusable(BOUNDED) is None
    assert "finite bounds, the task has none" in method.unusable(replace(BOUNDED, bounds=None))
    half = TARGET - 6.0, torch.tensor([float("inf"), 4.0], dtype=torch.float64)
    assert "finite bounds" in method.unusable(replace(BOUNDED, bounds=half))
    assert method.unusable(replace(BOUNDED, n=10)) is None
    assert "up to 10 parameters, the task has 11" in method.unusable(replace(BOUNDED, n=11))


@pytest.mark.parametrize("task", ["box10", "brdf"])
def test_the_engine_that_is_chosen_has_the_sigma_of_this_engine_alone(task):
    assert settings("auto", task) == settings("descent", task) != {}


def test_methods_of_the_loss_alone_are_for_tasks_that_have_more():
    for engine in ENGINES:
        assert METHODS[engine].unusable(replace(BOUNDED, output=None)) is None
        assert "returns the loss only" in METHODS[f"{engine}_loss"].unusable(replace(BOUNDED, output=None))


def test_rows_have_sigma_and_loss_of_the_search():
    trial = Trial(BOUNDED, "descent", 0)
    with pytest.raises(Exception, match=r"evaluations used up|both errors reduced"):
        METHODS["descent"](trial, {})
    assert trial.rows[1].sigma == pytest.approx(TASK.sigma, rel=0.6)
    best = min(float(TASK.loss(trial.start[None])[0]), *(row.loss for row in trial.rows[1:]))
    assert trial.rows[-1].loss == best == pytest.approx(trial.rows[-1].image_error)


@pytest.mark.parametrize(
    ("name", "small", "reason"),
    [
        ("block_gauss_newton", "box10", "made for 100 parameters and more"),
        ("local", "brdf", "made for 20 parameters and more, the task has 7"),
    ],
)
def test_gauss_newton_is_for_images_of_many_parameters(name, small, reason):
    method = METHODS[name]
    assert method.unusable(catalogue.load("texture")) is None
    assert reason in method.unusable(catalogue.load(small))
    assert "returns the loss only" in method.unusable(catalogue.load("quad"))
