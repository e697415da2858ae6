"""The sigma schedule: its values step by step, and resuming."""

import io

import numpy as np
import pytest
import torch
from document_texts import TEXTS, blocks

import torch_zerohess as zh
from truths import vector


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


def test_the_last_sigma_is_that_of_every_layer():
    """As `get_last_lr` of torch has one rate per group."""
    layers = [zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0)) for _ in range(2)]
    schedule = zh.LinearSigma(layers, 1.0, 0.5, steps=2)
    for expected in (1.0, 0.75, 0.5):
        assert schedule.get_last_sigma() == [expected, expected] == [layer.smoothing.sigma for layer in layers]
        schedule.step()
    each = zh.LinearSigma(layers, vector(1.0, 2.0), 0.5, steps=2)
    each.get_last_sigma()[0].zero_()  # it is the caller's
    assert torch.equal(each.sigma, vector(1.0, 2.0))
    assert torch.equal(layers[0].smoothing.sigma, vector(1.0, 2.0))


def test_one_sigma_per_parameter():
    """From start to end, element by element; a number stands for all of them."""
    layers = [zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=sigma)) for sigma in (9.0, vector(3.0, 4.0))]
    start, end = torch.tensor([1.0, 0.7]), [0.2, 0.1]
    schedule = zh.LinearSigma(layers, start, end, steps=3, hold=1)
    start *= 100  # it is the caller's
    for share in (0.0, 0.0, 1 / 3, 2 / 3, 1.0, 1.0):
        expected = (1 - share) * torch.tensor([1.0, 0.7]).double() + share * vector(*end)
        for layer in layers:
            assert layer.smoothing.sigma.dtype == torch.float64
            torch.testing.assert_close(layer.smoothing.sigma, expected, rtol=1e-15, atol=0.0)
        schedule.step()
    assert torch.equal(schedule.sigma, vector(*end))
    schedule.count = 2
    resumed = zh.LinearSigma(layers, vector(5.0, 5.0), 1.0, steps=1)
    assert torch.equal(resumed.sigma, vector(5.0, 5.0))
    resumed.step()
    assert torch.equal(layers[0].smoothing.sigma, vector(1.0, 1.0))
    file = io.BytesIO()
    torch.save(schedule.state_dict(), file)
    file.seek(0)
    resumed.load_state_dict(torch.load(file))
    assert torch.equal(layers[0].smoothing.sigma, schedule.sigma)
    assert float(layers[0](torch.zeros(1, 2, requires_grad=True)).detach()) == 0.0


def test_sigmas_of_wrong_sizes_and_values():
    alone = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0))
    layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=vector(3.0, 4.0)))
    two = vector(1.0, 2.0)
    wrong = [
        (alone, two, vector(1.0, 2.0, 3.0), "end must have one sigma per parameter, as start has 2, got 3"),
        (layer, 1.0, 0.5, r"start must have one sigma per parameter, as a layer has 2, got the number 1\.0"),
        (layer, vector(1.0, 2.0, 3.0), 0.5, "start must have one sigma per parameter, as a layer has 2, got 3"),
        (layer, 0.5, vector(1.0, 2.0, 3.0), "end must have one sigma per parameter, as a layer has 2, got 3"),
        (alone, vector(1.0, -2.0), two, r"start must be positive and finite, got -2\.0"),
        (alone, two, vector(1.0, float("inf")), "end must be positive and finite, got inf"),
        (alone, two, two.clone().requires_grad_(), r"end must not require grad: pass end\.detach\(\)"),
    ]
    for module, start, end, message in wrong:
        with pytest.raises(ValueError, match=f"^{message}$"):
            zh.LinearSigma(module, start, end, steps=2)
    for start in (torch.ones(2, 2), torch.ones(0), torch.ones(2, dtype=torch.bool)):
        with pytest.raises(TypeError, match=r"^start must be a positive number or a tensor \[n\], got"):
            zh.LinearSigma(alone, start, 1.0, steps=2)
    assert alone.smoothing.sigma == 9.0
    assert torch.equal(layer.smoothing.sigma, vector(3.0, 4.0))


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


def test_a_state_is_a_copy() -> None:
    layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=torch.ones(2)))
    schedule = zh.LinearSigma(layer, torch.ones(2), 0.5, steps=4)
    state = schedule.state_dict()
    state["start"].fill_(9.0)
    schedule.step()
    torch.testing.assert_close(schedule.sigma, torch.full((2,), 0.875, dtype=torch.float64))


def test_schedulers_of_torch_step_beside_it_and_refuse_it_inside() -> None:
    layer, weight = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0)), torch.zeros(1, requires_grad=True)
    optimizer = torch.optim.SGD([weight], lr=0.8)
    rate = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.5, total_iters=4)
    schedule = zh.LinearSigma(layer, 2.0, 1.0, steps=4)
    with pytest.raises(TypeError, match="should have `optimizer` as its attribute"):
        torch.optim.lr_scheduler.ChainedScheduler([rate, schedule])
    with pytest.raises(TypeError, match="should have `optimizer` as its attribute"):
        torch.optim.lr_scheduler.SequentialLR(optimizer, [rate, schedule], [2])
    for expected in (0.7, 0.6, 0.5, 0.4):
        optimizer.step()
        rate.step()
        schedule.step()
        assert rate.get_last_lr() == pytest.approx([expected])
        assert layer.smoothing.sigma == pytest.approx(2.5 * expected)


def test_the_hooks_of_the_guide_resume_a_schedule() -> None:
    """Two batches, a checkpoint and two batches, with the calls that Lightning makes: a line from 1 to 0.6."""
    names: dict = {"zh": zh}
    (code,) = [one for one in blocks(TEXTS["torch_zerohess/README.md"], "python") if "on_train_batch_end" in one]
    exec(code, names)

    class Model(names["Annealed"]):
        def __init__(self) -> None:
            self.layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0))
            self.annealing = zh.LinearSigma(self.layer, 1.0, 0.5, steps=5)

        def trained(self) -> list[float]:
            seen = []
            for batch_idx in range(2):
                seen.append(self.layer.smoothing.sigma)
                self.on_train_batch_end(None, None, batch_idx)
            return seen

    first, checkpoint = Model(), {}
    seen = first.trained()
    first.on_save_checkpoint(checkpoint)
    second = Model()
    second.on_load_checkpoint(checkpoint)
    assert seen + second.trained() + [second.layer.smoothing.sigma] == pytest.approx([1.0, 0.9, 0.8, 0.7, 0.6])
