"""Derivatives by the renderer: closed forms where they are right, and how the harness counts and replays them."""

import math
from dataclasses import asdict, replace
from functools import partial

import pytest
import torch
from small import TARGET, TASK
from small_scenes import RADIANCE, REFLECTANCE, VARIANTS, camera, lamp, plane, rgb, screen

from experiments.ensembles.kept_parts import KeptParts
from experiments.methods import METHODS
from experiments.problems import catalogue
from experiments.problems.scenes import adjoint
from experiments.problems.scenes.adjoint import ADJOINTS, unavailable, value_and_gradient
from experiments.problems.task import Renderer
from experiments.runs.trial import Trial
from experiments.studies.gradients import GradientError, differences, gradients
from torch_zerohess.adapters.mitsuba import MitsubaScene, Transform, Value


@pytest.fixture(params=VARIANTS)
def variant(request) -> str:
    return request.param


def weighted(weights):
    return lambda image: (weights * image).mean()


def check(scene, x, integrator, loss, expected, **tolerance):
    """Value and gradient are as expected, or refused where the variant has no derivatives."""
    x, expected = (torch.tensor(one).double() for one in (x, expected))
    if "_ad_" not in scene.variant:
        with pytest.raises(RuntimeError, match=r"mitsuba needs llvm_ad_rgb or cuda_ad_rgb .* here is scalar_rgb"):
            value_and_gradient(scene, x, integrator, loss, depth=2)
        return
    value, gradient = value_and_gradient(scene, x, integrator, loss, depth=2, seed=3)
    torch.testing.assert_close(value, loss(scene(x[None])[0].double()))
    torch.testing.assert_close(gradient, expected, **tolerance)


# Closed forms


@pytest.mark.parametrize("integrator", ["path", "prb"])
def test_loss_of_radiance_is_exact(variant, integrator) -> None:
    scene = MitsubaScene(lamp, [Value(RADIANCE)], spp=2, variant=variant, threads=1)
    target = torch.tensor([1.0, 2.0, 4.0]).double()
    expected = [2 * (x - y) / 3 for x, y in ((0.5, 1.0), (1.0, 2.0), (8.0, 4.0))]
    loss = lambda image: (image - target).square().mean()  # noqa: E731
    check(scene, [0.5, 1.0, 8.0], integrator, loss, expected, rtol=1e-5, atol=1e-6)


def test_reflectance_has_the_radiance_for_a_derivative(variant) -> None:
    """Image = albedo * radiance on average; the standard error of 4x4 pixels of 256 samples is below 1 %."""
    scene = MitsubaScene(plane, [Value(REFLECTANCE)], spp=256, depth=2, variant=variant, threads=1)
    check(scene, [0.4, 0.4, 0.4], "prb", weighted(1.0), [0.5 / 3, 1.0 / 3, 2.0 / 3], rtol=0.05, atol=0.0)


def test_one_value_for_all_elements_collects_their_derivatives(variant) -> None:
    grey = Value("screen.emitter.radiance.data", elements=1)
    scene = MitsubaScene(screen, [grey], spp=4, variant=variant, threads=1)
    check(scene, [1.0], "path", weighted(1.0), [1.0], rtol=1e-3, atol=0.0)


def test_elements_of_a_texture_have_the_weights_of_their_pixels(variant) -> None:
    weights = torch.arange(48).reshape(4, 4, 3).double()
    scene = MitsubaScene(screen, [Value("screen.emitter.radiance.data")], spp=4, variant=variant, threads=1)
    expected = weights.reshape(2, 2, 2, 2, 3).sum((1, 3)).flip(0).flatten() / 48
    check(scene, [1.0] * 12, "path", weighted(weights), expected.tolist(), rtol=1e-3, atol=1e-3)


def bright_square(mi):
    """Half side 0.5 where the view has 1, of radiance 1, before nothing."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": camera(mi, 8, 8),
        "square": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(0.5),
            "emitter": {"type": "area", "radiance": rgb(1.0, 1.0, 1.0)},
        },
    }


def test_only_silhouettes_tell_that_a_bright_square_moves(variant, monkeypatch) -> None:
    """The weight of a column is its place: the weighted mean grows by (1/2)^2, the square's part of the view."""
    monkeypatch.setattr(adjoint, "GUIDING", "none")
    adjoint.integrator_of.cache_clear()
    scene = MitsubaScene(
        bright_square, [Transform("square.to_world", move=((1, 0, 0), (0, 1, 0)))], spp=64, variant=variant, threads=1
    )
    columns = (torch.arange(8).double() + 0.5) / 4 - 1
    loss = weighted(columns[None, :, None])
    check(scene, [0.05, -0.03], "prb", loss, [0.0, 0.0])
    check(scene, [0.05, -0.03], "direct_projective", loss, [0.25, 0.0], rtol=0.0, atol=0.02)
    adjoint.integrator_of.cache_clear()


# What is refused


def test_the_reason_is_that_of_the_variant() -> None:
    assert "here is scalar_rgb" in str(unavailable("scalar_rgb"))
    assert (unavailable("auto") is None) == ("llvm_ad_rgb" in VARIANTS)


@pytest.mark.parametrize(
    ("integrator", "depth", "message"),
    [
        ("volpath", 2, f"integrator must be one of {', '.join(ADJOINTS)}, got 'volpath'"),
        ("direct_projective", 4, "direct light, depth 2, got 4"),
    ],
)
def test_wrong_integrators(integrator, depth, message) -> None:
    scene = MitsubaScene(lamp, [Value(RADIANCE)], spp=1, variant="scalar_rgb", threads=1)
    with pytest.raises(ValueError, match=message):
        value_and_gradient(scene, scene.x0, integrator, weighted(1.0), depth=depth)


# The harness


def bowl(calls, x, integrator, seed):
    calls.append((integrator, seed))
    return (x - TARGET).square().sum(), 2 * (x - TARGET)


def differentiable(calls, no_adjoint=lambda: None, **more):
    renderer = Renderer(partial(bowl, calls), ("path", "prb", "prb_projective"), no_adjoint)
    return replace(TASK, renderer=renderer, **more)


def test_a_derivative_counts_as_two_evaluations() -> None:
    calls = []
    trial = Trial(differentiable(calls), "m", 0)
    value, gradient = trial.adjoint(trial.start, "prb", 5)
    assert (trial.evaluations, calls) == (2, [("prb", 5)])
    assert value == pytest.approx(float((trial.start - TARGET).square().sum()))
    torch.testing.assert_close(gradient, 2 * (trial.start - TARGET))
    with pytest.raises(ValueError, match=r"bowl has \(path, prb, prb_projective\), got direct_projective"):
        trial.adjoint(trial.start, "direct_projective")
    with pytest.raises(ValueError, match=r"\(none\), got prb"):
        Trial(TASK, "m", 0).adjoint(trial.start, "prb")


def test_a_run_that_was_killed_does_not_render_again(tmp_path) -> None:
    def steps(trial, count):
        x = trial.start
        for _ in range(count):
            x = x - 0.05 * trial.adjoint(x, "prb")[1]
            trial.report(x)
        return x

    calls = []
    killed = Trial(differentiable(calls), "m", 0, tmp_path)
    steps(killed, 4)
    killed.close(ended=False)
    assert len(calls) == 4
    again = Trial(differentiable(calls), "m", 0, tmp_path)
    x = steps(again, 6)
    again.close(ended=True)
    assert len(calls) == 6
    assert again.evaluations == 12
    torch.testing.assert_close(x, steps(Trial(differentiable([]), "m", 0), 6), rtol=0.0, atol=0.0)


@pytest.mark.parametrize(
    ("name", "integrator"), [("mitsuba", "prb"), ("mitsuba_path", "path"), ("mitsuba_projective", "prb_projective")]
)
def test_adam_on_the_derivative_gets_there_within_the_bounds(name, integrator) -> None:
    calls, points = [], []
    bounds = TARGET - 4, TARGET + torch.tensor([4.0, -0.5])  # the solution is beyond the second
    task = differentiable(calls, bounds=bounds, start=lambda run: TARGET + torch.tensor([3.0, -3.0]).double())
    trial = Trial(task, name, 0, watch=lambda row: points.append(row.image_error))
    with pytest.raises(Exception, match="evaluations used up"):
        METHODS[name].solve(trial, {"rate": 0.3, "steps": 150})
    torch.testing.assert_close(trial.x, TARGET + torch.tensor([0.0, -0.5]), rtol=0.0, atol=0.01)
    assert trial.evaluations == task.evaluations
    assert {one for one, _ in calls} == {integrator}
    assert len({seed for _, seed in calls}) == len(calls)


def test_methods_say_where_they_do_not_apply() -> None:
    method = METHODS["mitsuba"]
    assert method.applies(TASK) == "the black box has no derivative of its own"
    assert method.applies(differentiable([])) is None
    assert method.applies(differentiable([], no_adjoint=lambda: "no LLVM")) == "no LLVM"


def test_differences_of_a_quadratic_are_its_gradient() -> None:
    x = torch.tensor([1.0, 2.0]).double()
    gradient, error = differences(lambda points: points.square().sum(1), x, 0.3)
    torch.testing.assert_close(gradient, 2 * x)
    assert float(error.max()) < 1e-12


def test_command_measures_sampled_gradients_where_there_are_no_others(capsys, monkeypatch, tmp_path) -> None:
    def measured(variant="scalar_rgb") -> list[GradientError]:
        return gradients(("shad",), repeats=1, spp=4, pairs=(4,), variant=variant, out=tmp_path)

    found = measured()
    assert "shad: mitsuba needs llvm_ad_rgb" in capsys.readouterr().out
    assert [(one.point, one.method, one.evaluations) for one in found] == [
        (point, *kind) for point in ("start", "middle", "near") for kind in (("truth", 0), ("sampled, 4 pairs", 8))
    ]
    assert all(-1 <= one.cosine <= 1 and math.isfinite(one.error) and one.truth > 0 for one in found)
    near = found[-1]
    assert near.way > 0.5  # a step against it leads to the solution
    monkeypatch.setattr("experiments.studies.gradients.differences", None)  # nothing is measured twice
    monkeypatch.setattr(adjoint, "find_llvm", lambda: None)
    again = measured("auto")  # which is scalar_rgb without an LLVM
    for one, before in zip(again, found, strict=True):
        assert repr(asdict(one)) == repr(asdict(before))  # NaN too
    with pytest.raises(SystemExit, match="at least 1"):
        gradients(("shad",), repeats=0)


def test_scenes_are_released_before_the_next_one_is_loaded(monkeypatch, tmp_path) -> None:
    events, load = [], catalogue.load

    def noted(name, *rest):
        events.append(f"load {name}")
        task = load(name, *rest)
        return replace(task, renderer=replace(task.renderer, release=lambda: events.append(f"release {name}")))

    monkeypatch.setattr(catalogue, "load", noted)
    monkeypatch.setattr(KeptParts, "rows", lambda *_: [])
    gradients(("shad", "mug"), variant="scalar_rgb", out=tmp_path)
    assert events == ["load shad", "release shad", "load mug", "release mug"]
