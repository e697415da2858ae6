"""The sigma schedule: its values step by step, and resuming."""

import pytest

import torch_zerohess as zh


def test_linear_sigma():
    layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0))
    schedule = zh.LinearSigma([layer], 1.0, 0.2, steps=4, hold=1)
    seen = [layer.smoothing.sigma]
    for _ in range(7):
        schedule.step()
        seen.append(layer.smoothing.sigma)
    assert seen == pytest.approx([1.0, 1.0, 0.8, 0.6, 0.4, 0.2, 0.2, 0.2])
    other = zh.LinearSigma(layer, 5.0, 4.0, steps=1)
    schedule.count = 2
    other.load_state_dict(schedule.state_dict())
    assert layer.smoothing.sigma == pytest.approx(0.8)
    for settings in ({"start": 0.0}, {"end": -1.0}, {"steps": 0}, {"hold": -1}):
        arguments = {"start": 1.0, "end": 0.5, "steps": 2} | settings
        with pytest.raises(ValueError, match=next(iter(settings))):
            zh.LinearSigma(layer, **arguments)
    with pytest.raises(TypeError, match="BlackBox"):
        zh.LinearSigma([lambda z: z], 1.0, 0.5, steps=2)
