"""Network tasks at a size for tests: the real scenes and networks, their images, and how the tasks travel."""

import pickle

import pytest
import torch
from small import BUMP, SIZE, Bump

from experiments.problems import catalogue
from experiments.problems.network_task import Size
from experiments.problems.tasks import cnn

TINY = Size(32, 2, 2, evaluations=40, images=6, held_out=3)


def made(name, size=TINY):
    return type(catalogue.load(name))(size, "scalar_rgb", 1)


@pytest.mark.parametrize("preset", ["fast", "paper"])
@pytest.mark.parametrize(
    ("name", "weights"), [("cnn", 267_745), ("cnn_wide", 267_745), ("cnn5", 268_773), ("cnn_texture", None)]
)
def test_networks_have_the_size_of_the_source_and_predict_within_the_ranges(name, weights, preset):
    task = catalogue.load(name, preset)
    network = task.encoder()
    x = network(torch.rand(2, 3, task.size.film, task.size.film))
    assert x.shape == (2, task.n)
    if weights:
        assert sum(p.numel() for p in network.parameters()) == weights
        assert bool(((network.lower < x) & (x < network.upper)).all())


@pytest.mark.parametrize("name", catalogue.NETWORKS)
def test_parameters_can_be_predicted_and_change_the_image(name):
    task = made(name)
    images, x = task.training(0)
    unseen, others = task.held_out
    shape = (2,) if name == "cnn_throw" else (3, 32, 32)
    assert images.shape == (6, *shape)
    assert unseen.shape == (3, *shape)
    assert x.shape == (6, task.n)
    assert not torch.isclose(x[:, None], others[None]).all(2).any()
    assert float(task.loss(x, images).max()) < 1e-12
    away = x + 0.5 * task.sigma[0] * torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    assert float(task.loss(away, images).min()) > 1e-6
    assert task.pictures(images, x).shape[:2] == (6, 32)
    assert task.caption(x[0])


def test_angles_are_those_of_the_source():
    task = made("cnn", Size(16, 1, 2, evaluations=1, images=64, held_out=64))
    for angles in (task.training(0)[1], task.held_out[1]):
        low, high = cnn.Rotation.angles
        assert low <= float(angles.min()) < low + 0.1 * (high - low)
        assert high >= float(angles.max()) > high - 0.1 * (high - low)


def test_images_are_those_of_the_run_and_the_held_out_ones_of_all_runs():
    task = Bump(SIZE)
    images, x = task.training(3)
    held_out = task.held_out
    torch.testing.assert_close(task.image(x), images)
    assert not set(x.flatten().tolist()) & set(held_out[1].flatten().tolist())
    other = task.training(4)[1]
    assert not torch.equal(other, x)
    assert task.held_out[1] is held_out[1]
    assert torch.equal(task.training(3)[1], x)


def test_images_are_rendered_once_and_say_how_far_they_are():
    task, told = Bump(Size(16, 1, 2, evaluations=1, images=40, held_out=4)), []
    task.prepare(0, lambda *progress: told.append(progress))
    assert told == [(0, 44), (16, 44), (32, 44), (40, 44)]
    task.prepare(0, lambda *progress: told.append(progress))
    assert len(told) == 4
    task.prepare(1, lambda *progress: told.append(progress))
    assert told[4:] == [(0, 40), (16, 40), (32, 40)]


def test_a_task_travels_without_its_images():
    BUMP.prepare(0)
    sent = pickle.dumps(BUMP)
    assert len(sent) < 1000
    torch.testing.assert_close(pickle.loads(sent).training(0)[0], BUMP.training(0)[0])


def test_runs_start_from_weights_of_their_own():
    encoder, start = BUMP.encoders(5)
    drawn = torch.rand(1)
    again, _ = BUMP.encoders(5)
    assert torch.equal(torch.rand(1), drawn)  # the generator is seeded as well
    other, _ = BUMP.encoders(6)
    for a, b, c in zip(encoder.parameters(), start.parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b)
        assert torch.equal(a, c)
        assert a is not b
    assert not torch.equal(next(encoder.parameters()), next(other.parameters()))


def test_errors_are_of_the_held_out_images():
    BUMP.prepare(0)
    images, x = BUMP.held_out

    class Constant(torch.nn.Module):
        def forward(self, image):
            return torch.full((len(image), 1), 13.0)

    assert BUMP.parameter_error(Constant()) == pytest.approx(float((13.0 - x).square().mean()))
    expected = float((BUMP.image(torch.full((1, 1), 13.0)) - images).square().mean())
    assert BUMP.image_error(Constant()) == pytest.approx(expected, rel=1e-5)


@torch.no_grad()
def test_the_decoder_begins_as_a_linear_interpolation_of_the_image() -> None:
    decoder = catalogue.load("cnn_texture").encoder()
    ramp = torch.linspace(-1.0, 1.0, 96)
    for one in (decoder.across, decoder.down):
        small = one(ramp)
        torch.testing.assert_close(one(torch.ones(96)), torch.ones(32))
        torch.testing.assert_close(small[1:-1].diff(), torch.full((29,), 3.0 * 2.0 / 95.0))
        assert abs(float(small.mean())) < 1e-6
