"""Evaluations of `minimize` in a memory: every one, as fn returned it, of use to an estimate and a layer."""

import pytest
import torch
from searches import noisy, raising, tilted, zeros

import torch_zerohess as zh
from truths import vector

FREQUENCIES = vector(1.0, -0.6)
SETTINGS = {"sigma": 1.0, "seed": 0, "max_evaluations": 30}


def wave(z):
    return 3.0 - torch.cos(z @ FREQUENCIES) - torch.cos(z[:, 0])


def picture(z):
    return torch.stack([torch.sin(z @ FREQUENCIES), torch.cos(z[:, 0]), z[:, 1]], 1).unflatten(1, (3, 1))


RETURNED = {
    "numbers": (wave, None),
    "a column": (lambda z: wave(z)[:, None], None),
    "images": (picture, lambda y: (y - picture(vector(0.3, -0.2)[None])[0]).square().sum()),
}


@pytest.mark.parametrize("name", RETURNED)
def test_a_memory_has_every_point_and_output(name):
    fn, loss = RETURNED[name]
    memory = zh.Memory()
    fit = zh.minimize(fn, zeros(2), loss=loss, memory=memory, **SETTINGS)
    plain = zh.minimize(fn, zeros(2), loss=loss, **SETTINGS)
    assert memory.evaluations == len(memory) == fit.evaluations
    assert torch.equal(memory.points, fit.points)
    assert torch.equal(memory.outputs, fn(fit.points))
    assert torch.equal(plain.points, fit.points)
    assert torch.equal(plain.values, fit.values)


@pytest.mark.parametrize("name", RETURNED)
def test_an_estimate_gains_from_it(name):
    """The first estimate finds out what the surrogate is worth, the second one subtracts it.

    Two estimates alone have no surrogate yet to find out about. Samples depend on the evaluations of a memory.
    """
    fn, loss = RETURNED[name]
    memory, few = zh.Memory(), zh.Memory()
    fit = zh.minimize(fn, zeros(2), loss=loss, memory=memory, **SETTINGS)

    def error(memory, seed, taken=0):
        seed = zh.Smoothing(sigma=0.3, seed=seed).drawn_seed(taken)
        smoothing = zh.Smoothing(sigma=0.3, samples=4, seed=seed)
        found = zh.estimate(fn, fit.x + 0.2, smoothing, memory=memory, value="smoothed")
        return float(found.standard_error("gradient").square().sum().sqrt())

    for seed in (1, 2):
        alone = error(None, seed, few.evaluations)
        with_few, with_all = (error(one, seed) for one in (few, memory))
    assert with_few == alone
    assert with_all < 0.5 * alone


def test_a_layer_trains_on():
    memory = zh.Memory(draws=64)
    fit = zh.minimize(picture, zeros(2), loss=RETURNED["images"][1], memory=memory, **SETTINGS)
    layer = zh.BlackBox(picture, zh.Smoothing(sigma=0.3, samples=2, seed=3), memory=memory)
    x = fit.x.clone().requires_grad_()
    optimizer, wanted = torch.optim.SGD([x], lr=0.2), picture(vector(0.7, 0.3)[None])[0]
    losses = []
    for _ in range(8):
        optimizer.zero_grad()
        loss = (layer(x) - wanted).square().sum()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.05 * losses[0]
    assert memory.evaluations == fit.evaluations + 8 * 5
    assert memory.coefficient > 0.9


def test_what_was_evaluated_before_an_end_is_kept(tmp_path):
    """Ctrl-C, an exception of fn or of the loss, and a second call that goes on from a file."""
    memory, path = zh.Memory(), tmp_path / "search.pt"
    settings = {**SETTINGS, "memory": memory, "checkpoint": path}
    fit = zh.minimize(raising(tilted, 3, KeyboardInterrupt), zeros(2), **settings)
    assert torch.equal(memory.points, fit.points)
    with pytest.raises(ZeroDivisionError) as caught:
        zh.minimize(raising(tilted, 3), zeros(2), **settings)
    assert torch.equal(memory.points, caught.value.minimum.points)
    fit = zh.minimize(tilted, zeros(2), **settings)
    assert torch.equal(memory.points, fit.points)
    assert torch.equal(memory.outputs, fit.values)
    memory = zh.Memory()
    with pytest.raises(ZeroDivisionError):
        zh.minimize(tilted, zeros(2), loss=raising(torch.sum, 0), memory=memory, **SETTINGS)
    assert len(memory) > 0


def test_a_function_that_writes_to_its_points_does_not_change_a_memory():
    def writing(z):
        values = tilted(z)
        z.zero_()
        return values

    memory = zh.Memory()
    fit = zh.minimize(writing, zeros(2), memory=memory, **SETTINGS)
    assert torch.equal(memory.points, fit.points)


def test_what_repeats_for_noise_is_kept_too():
    memory = zh.Memory()
    fit = zh.minimize(noisy(tilted, 0.1, 0), zeros(2), memory=memory, **SETTINGS)
    assert fit.noise > 0
    torch.testing.assert_close(memory.points, fit.points, rtol=0, atol=0)
    torch.testing.assert_close(memory.outputs, fit.values, rtol=0, atol=0)
