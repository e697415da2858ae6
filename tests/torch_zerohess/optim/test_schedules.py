"""The sigma schedule: its values step by step, and resuming."""

import numpy as np
import pytest
import torch

import torch_zerohess as zh


def test_linear_sigma():
    layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0))
    schedule = zh.LinearSigma([layer], 1.0, 0.2, steps=4, hold=1)
    seen = [layer.smoothing.sigma]
    for _ in range(7):
        schedule.step()
        seen.append(layer.smoothing.sigma)
    assert seen == pytest.approx([1.0, 1.0, 0.8, 0.6, 0.4, 0.2, 0.2, 0.2])
    assert (seen[0], seen[-1]) == (1.0, 0.2)
    other = zh.LinearSigma(layer, 5.0, 4.0, steps=1)
    schedule.count = 2
    other.load_state_dict(schedule.state_dict())
    assert layer.smoothing.sigma == pytest.approx(0.8)
    wrong = (
        ({"start": 0.0}, ValueError),
        ({"start": "a"}, TypeError),
        ({"end": -1.0}, ValueError),
        ({"end": float("inf")}, ValueError),
        ({"steps": 0}, ValueError),
        ({"steps": 2.5}, TypeError),
        ({"hold": -1}, ValueError),
    )
    for settings, error in wrong:
        arguments = {"start": 1.0, "end": 0.5, "steps": 2} | settings
        with pytest.raises(error, match=next(iter(settings))):
            zh.LinearSigma(layer, **arguments)
    with pytest.raises(TypeError, match="BlackBox"):
        zh.LinearSigma([lambda z: z], 1.0, 0.5, steps=2)
    for nothing in ([], 5, torch.nn.Linear(1, 1)):
        with pytest.raises(TypeError, match=r"module_or_modules must .*got"):
            zh.LinearSigma(nothing, 1.0, 0.5, steps=2)


def test_a_state_with_wrong_numbers_changes_nothing():
    layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0))
    schedule = zh.LinearSigma(layer, 1.0, 0.5, steps=2)
    state = schedule.state_dict()
    for wrong in ({"steps": 0}, {"hold": -1}, {"count": -1}, {"start": 0.0}, {"end": float("nan")}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            schedule.load_state_dict(state | {"start": 3.0} | wrong)
        assert schedule.state_dict() == state
    with pytest.raises(TypeError, match=r"steps must be an integer, got 2\.0"):
        schedule.load_state_dict(state | {"steps": 2.0})
    assert layer.smoothing.sigma == 1.0


def test_numbers_of_every_kind():
    layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0))
    schedule = zh.LinearSigma(layer, torch.tensor(2.0), np.float32(1.0), steps=np.int64(2), hold=torch.tensor(1))
    schedule.step()
    schedule.step()
    assert layer.smoothing.sigma == 1.5
    assert {type(value) for value in schedule.state_dict().values()} <= {int, float}


def test_layers_inside_of_modules():
    layers = [zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0)) for _ in range(3)]
    network = torch.nn.Sequential(torch.nn.Linear(2, 2), layers[0], torch.nn.Sequential(layers[1]))
    schedule = zh.LinearSigma(module_or_modules=network, start=1.0, end=0.5, steps=2)
    schedule.step()
    assert [layer.smoothing.sigma for layer in layers] == [0.75, 0.75, 9.0]
    zh.LinearSigma([network, layers[2], layers[2]], 2.0, 1.0, 1)
    assert [layer.smoothing.sigma for layer in layers] == [2.0, 2.0, 2.0]
