"""Settings as values: equal, hashable, and made of numbers that any file keeps."""

import copy
import io
import itertools
import pickle

import numpy as np
import pytest
import torch

import torch_zerohess as zh


def test_equal_settings_are_equal():
    one = zh.Smoothing(sigma=[0.1, 0.2], samples=4)
    assert one == one.replace()
    assert hash(one) == hash(zh.Smoothing(sigma=torch.tensor([0.1, 0.2], dtype=torch.float64), samples=4))
    others = [one.replace(samples=5), one.replace(sigma=0.1), one.replace(sigma=[0.1, 0.3]), one.replace(seed=1)]
    assert len({one, *others}) == 5
    assert one != "text"


def test_nobody_can_write_to_a_sigma():
    """Neither to the tensor that was given, nor to the tensor that is read."""
    given = torch.tensor([1.0, 2.0])
    settings = zh.Smoothing(sigma=given, seed=0)
    given[0] = settings.sigma[0] = -1.0
    assert settings.sigma.tolist() == settings.sigma_vector(2, given.device).tolist() == [1.0, 2.0]
    for copied in (pickle.loads(pickle.dumps(settings)), copy.deepcopy(settings)):
        assert copied == settings
    with pytest.raises(TypeError, match="'sigma'"):
        zh.Smoothing(samples=4)


@pytest.mark.parametrize("number", [np.int64(4), np.uint8(4), torch.tensor(4)])
def test_integers_of_every_kind_are_those_of_python(number):
    settings = zh.Smoothing(
        sigma=1.0, samples=number, seed=number, scrambles=number, sampler="sobol", order=number // 4, antithetic=1
    )
    assert {type(getattr(settings, name)) for name in ("samples", "seed", "scrambles", "order")} == {int}
    assert settings.antithetic is True
    file = io.BytesIO()
    torch.save(zh.BlackBox(torch.sum, settings).state_dict(), file)
    file.seek(0)
    other = zh.BlackBox(torch.sum, zh.Smoothing(sigma=3.0))
    other.load_state_dict(torch.load(file))  # with weights_only
    assert other.smoothing == settings


@pytest.mark.parametrize("antithetic", [True, False, "auto"])
@pytest.mark.parametrize("sampler", ["random", "sobol", "orthogonal", "auto"])
@pytest.mark.parametrize("proposal", ["aggregate", "gaussian", "optimal", "uniform", "fr22", "auto"])
def test_settings_serve_some_number_of_parameters_or_are_refused(proposal, sampler, antithetic):
    """Baseline "mean" needs two independent draws. One parameter has as many as any other number of parameters."""
    x, served = torch.tensor([0.3], dtype=torch.float64), []
    for samples, scrambles, order in itertools.product(range(1, 8), (None, 1, 2), (1, 2)):
        try:
            settings = zh.Smoothing(
                sigma=1.0,
                samples=samples,
                scrambles=scrambles,
                order=order,
                proposal=proposal,
                sampler=sampler,
                antithetic=antithetic,
                baseline="mean",
            )
        except ValueError:
            continue
        zh.estimate(lambda z: z.square().sum(1), x, settings)
        served.append(samples)
    assert served or sampler not in ("random", "auto")


def test_settings_that_serve_one_parameter_alone_are_made():
    """Single Sobol points are twice as many as pairs, hence even; pairs are chosen for more than one parameter."""
    settings = zh.Smoothing(sigma=1.0, samples=7, sampler="sobol", baseline="mean", antithetic="auto")
    assert settings.resolved(1).scrambles == 2
    with pytest.raises(ValueError, match=r"samples must be even, .*got samples=7"):
        settings.resolved(2)


def smoothed(sigma, x):
    """F of the sum of squares at x."""
    return zh.BlackBox(lambda z: z.square().sum(1), zh.Smoothing(sigma=sigma, samples=4, seed=0), value="smoothed")(x)


@pytest.mark.parametrize(
    "derivative",
    [
        torch.func.grad(lambda s: smoothed(s, torch.ones(2))),
        torch.func.jacfwd(lambda s: smoothed(s, torch.ones(2))),
        torch.func.jacfwd(lambda s: smoothed(s, s * torch.ones(2))),
        torch.func.grad(lambda s: smoothed([s, 2 * s], torch.ones(2))),
        torch.func.jacfwd(lambda s: smoothed((s, 2 * s), torch.ones(2))),
    ],
    ids=["grad", "jacfwd", "jacfwd also of x", "grad of a list", "jacfwd of a tuple"],
)
def test_derivatives_by_sigma_are_refused(derivative):
    """F of the sum of squares has the derivative 2 n sigma, and no layer has it: zero would be wrong."""
    with pytest.raises(ValueError, match=r"sigma must not (require grad|be differentiated).*: pass sigma.detach\(\)"):
        derivative(torch.tensor(0.3))


def test_a_sigma_that_is_detached_inside_of_a_transform_is_a_number():
    """Of a linear f on 4 pairs of the same samples, the slope by s of f(s v) is v times its slope by x."""
    f = zh.BlackBox(lambda z: 3 * z.sum(1), zh.Smoothing(sigma=0.3, samples=4, seed=0))
    slope = torch.func.grad(f)(torch.tensor([1.0]))
    moved = lambda s: zh.BlackBox(  # noqa: E731
        lambda z: 3 * z.sum(1), zh.Smoothing(sigma=s.detach(), samples=4, seed=0)
    )(s * torch.tensor([2.0]))
    torch.testing.assert_close(torch.func.jacfwd(moved)(torch.tensor(0.3)), 2 * slope[0])


def test_settings_that_vmap_maps_over_are_refused():
    with pytest.raises(ValueError, match="sigma must not be mapped over by vmap: call one layer after the other"):
        torch.func.vmap(lambda s: smoothed(s, torch.ones(2)))(torch.tensor([0.3, 0.4]))
    with pytest.raises(TypeError, match="seed must be an integer, got BatchedTensor"):
        torch.func.vmap(lambda s: torch.tensor(zh.Smoothing(sigma=0.3, seed=s).seed))(torch.tensor([3, 4]))
