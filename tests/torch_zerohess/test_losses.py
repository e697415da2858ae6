"""Image losses against closed forms, scikit-image, and finite differences of themselves."""

import pickle
import sys

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

import torch_zerohess as zh

FACTORIES = {
    "mse": zh.losses.mse,
    "multiscale_mse": lambda target: zh.losses.multiscale_mse(target, levels=3),
    "ssim": lambda target: zh.losses.ssim(target, window_size=5),
}
EACH = pytest.mark.parametrize("name", FACTORIES)


def images(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("d", [0.0, 0.25, -3.0])
@pytest.mark.parametrize("shape", [(13, 10), (13, 10, 3), (8, 8, 1)])
def test_a_constant_difference_counts_fully_at_every_scale(shape, d) -> None:
    target = images(*shape)
    assert float(zh.losses.mse(target)(target + d)) == pytest.approx(d**2, abs=1e-15)
    for levels in (1, 2, 3, 4):
        assert float(zh.losses.multiscale_mse(target, levels)(target + d)) == pytest.approx(d**2, abs=1e-15)


def test_one_pixel_at_three_scales() -> None:
    target = images(4, 4)
    image = target.clone()
    image[2, 1] += 1
    # Means over 16 pixels, 4 cells of a quarter each, one cell of a sixteenth.
    expected = (1 / 16 + (1 / 4) ** 2 / 4 + (1 / 16) ** 2) / 3
    assert float(zh.losses.multiscale_mse(target, levels=3)(image)) == pytest.approx(expected, rel=1e-12)
    assert float(zh.losses.mse(target)(image)) == pytest.approx(1 / 16, rel=1e-12)


def test_cells_at_the_edge_average_the_pixels_they_have() -> None:
    image = torch.zeros(3, 3)
    image[2, 2] = 1  # alone in its cell at the second scale, where cells have 4, 2, 2 and 1 pixels
    assert float(zh.losses.multiscale_mse(torch.zeros(3, 3), levels=2)(image)) == pytest.approx((1 / 9 + 1 / 4) / 2)


def test_channels_count_equally() -> None:
    target, image = images(9, 12, 3), images(9, 12, 3, seed=1)
    for make in FACTORIES.values():
        channels = [make(target[..., c])(image[..., c]) for c in range(3)]
        assert float(make(target)(image)) == pytest.approx(float(torch.stack(channels).mean()), rel=1e-12)


@EACH
def test_equal_images_have_no_loss(name) -> None:
    for target in (images(12, 9, 3), torch.zeros(12, 9, dtype=torch.float64)):
        assert float(FACTORIES[name](target)(target)) == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize(("p", "q", "data_range"), [(0.2, 0.9, 1.0), (0.0, 1.0, 1.0), (30.0, 200.0, 255.0)])
def test_dissimilarity_of_flat_images(p, q, data_range) -> None:
    # Without variance the second factor is b / b.
    a = (0.01 * data_range) ** 2
    expected = 1 - (2 * p * q + a) / (p**2 + q**2 + a)
    one = torch.full((15, 13), p, dtype=torch.float64)
    loss = zh.losses.ssim(torch.full_like(one, q), data_range=data_range)
    assert float(loss(one)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("shape", [(24, 17), (24, 17, 3)])
def test_dissimilarity_as_scikit_image_has_it(shape) -> None:
    target, image = images(*shape), images(*shape, seed=1)
    image = 0.7 * target + 0.3 * image
    similarity = structural_similarity(
        image.numpy(),
        target.numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1 if len(shape) == 3 else None,
    )
    loss = float(zh.losses.ssim(target)(image))
    assert loss == pytest.approx(1 - similarity, rel=1e-9)
    assert 0.01 < loss < 1


@pytest.mark.parametrize("level", [1.0, 30.0, 1000.0])
def test_dissimilarity_of_bright_flat_images_in_float32(level) -> None:
    target, image = torch.full((16, 16), level), level + 0.01 * images(16, 16).float()
    expected = float(zh.losses.ssim(target.double())(image.double()))
    assert float(zh.losses.ssim(target)(image)) == pytest.approx(expected, rel=1e-5)


def test_dissimilarity_of_one_small_window() -> None:
    target, image = images(3, 3), images(3, 3, seed=1)
    weights = np.exp(-0.5 * (np.array([-1.0, 0.0, 1.0]) / 1.5) ** 2)
    weights = np.outer(weights, weights) / weights.sum() ** 2
    x, y = image.numpy(), target.numpy()
    m, n = (weights * x).sum(), (weights * y).sum()
    v, w, k = (weights * (x - m) ** 2).sum(), (weights * (y - n) ** 2).sum(), (weights * (x - m) * (y - n)).sum()
    expected = 1 - (2 * m * n + 1e-4) * (2 * k + 9e-4) / ((m**2 + n**2 + 1e-4) * (v + w + 9e-4))
    assert float(zh.losses.ssim(target, window_size=3)(image)) == pytest.approx(expected, rel=1e-10)


@EACH
@pytest.mark.parametrize("shape", [(9, 7), (9, 7, 2)])
def test_derivatives_are_those_of_finite_differences(name, shape) -> None:
    loss = FACTORIES[name](images(*shape))
    x = images(*shape, seed=1).requires_grad_(True)
    assert torch.autograd.gradcheck(loss, (x,))
    assert torch.autograd.gradgradcheck(loss, (x,))


@EACH
def test_hessians_of_torch_func_are_those_of_finite_differences(name) -> None:
    loss = FACTORIES[name](images(8, 6))
    x, v = images(8, 6, seed=1), images(8, 6, seed=2) - 0.5
    hessian = torch.func.hessian(loss)(x).reshape(48, 48)
    assert torch.allclose(hessian, hessian.mT, atol=1e-14)
    step = 1e-4
    ahead, behind = (torch.func.grad(loss)(x + side * step * v) for side in (1, -1))
    slope = ((ahead - behind) / (2 * step)).flatten()
    # Rounding 1e-16 / step and the third derivative times step^2.
    assert torch.allclose(hessian @ v.flatten(), slope, rtol=1e-4, atol=1e-7)
    bend = (loss(x + step * v) - 2 * loss(x) + loss(x - step * v)) / step**2
    assert float(v.flatten() @ hessian @ v.flatten()) == pytest.approx(float(bend), rel=1e-3)


@EACH
@pytest.mark.parametrize("shape", [(9, 7), (9, 7, 3)])
def test_batches_are_images_one_by_one(name, shape) -> None:
    loss = FACTORIES[name](images(*shape))
    batch = images(2, 4, *shape, seed=1)
    one_by_one = torch.stack([torch.stack([loss(image) for image in row]) for row in batch])
    assert torch.allclose(loss(batch), one_by_one, rtol=1e-12)
    assert torch.allclose(torch.func.vmap(torch.func.vmap(loss))(batch), one_by_one, rtol=1e-12)
    slopes = torch.func.vmap(torch.func.grad(loss))(batch[0])
    assert torch.allclose(slopes[1], torch.func.grad(loss)(batch[0, 1]), rtol=1e-12)
    assert loss(batch[:0]).shape == (0, 4)


@EACH
def test_the_image_decides_on_the_type(name) -> None:
    target, image = images(9, 7, 3), images(9, 7, 3, seed=1)
    exact = FACTORIES[name](target)(image)
    for made_for in (target, target.float(), target.numpy()):
        loss = FACTORIES[name](made_for)
        assert loss(image).dtype == torch.float64
        rounded = loss(image.float())
        assert rounded.dtype == torch.float32
        assert float(rounded) == pytest.approx(float(exact), rel=1e-4)


@EACH
def test_the_target_is_kept(name) -> None:
    target = images(9, 7)
    loss = FACTORIES[name](target)
    before = float(loss(torch.zeros_like(target)))
    target.zero_()
    assert float(loss(target)) == before > 0


@EACH
def test_pickled_losses_are_the_same(name) -> None:
    loss, image = FACTORIES[name](images(9, 7)), images(9, 7, seed=1)
    assert float(pickle.loads(pickle.dumps(loss))(image)) == float(loss(image))


@EACH
def test_wrong_images_are_named(name) -> None:
    loss = FACTORIES[name](images(8, 6, 3))
    for wrong in ((8, 6), (6, 8, 3), (8, 6, 4), (3, 8, 6)):
        got = ", ".join(map(str, wrong))
        with pytest.raises(ValueError, match=rf"image must be \[\*batch, 8, 6, 3\] .*got \[{got}\]"):
            loss(torch.zeros(wrong))
    for wrong in (torch.zeros(8, 6, 3, dtype=torch.uint8), np.zeros((8, 6, 3))):
        with pytest.raises(TypeError, match=r"image must be a floating-point tensor, got .*(uint8|float64|ndarray)"):
            loss(wrong)


@EACH
def test_wrong_targets_are_named(name) -> None:
    with pytest.raises(ValueError, match=r"target must be \[h, w\] or \[h, w, c\], got \[2, 8, 6, 3\]"):
        FACTORIES[name](torch.zeros(2, 8, 6, 3))
    with pytest.raises(TypeError, match=r"target must be floating-point.* got torch\.uint8"):
        FACTORIES[name](torch.zeros(8, 6, dtype=torch.uint8))
    with pytest.raises(ValueError, match="target must be finite"):
        FACTORIES[name](torch.full((8, 6), torch.nan))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: zh.losses.multiscale_mse(images(7, 20)), r"must be at least 8x8 pixels for 4 levels, got \[7, 20\]"),
        (lambda: zh.losses.multiscale_mse(images(7, 20), levels=0), "levels must be at least 1, got 0"),
        (lambda: zh.losses.ssim(images(20, 10, 3)), r"at least 11x11 pixels for a window of 11, got \[20, 10, 3\]"),
        (lambda: zh.losses.ssim(images(20, 20), window_size=8), "window_size must be odd and at least 3, got 8"),
        (lambda: zh.losses.ssim(images(20, 20), data_range=0.0), "data_range must be positive and finite, got 0.0"),
    ],
)
def test_wrong_settings_are_named(make, message) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_a_window_has_a_whole_number_of_pixels() -> None:
    with pytest.raises(TypeError, match=r"window_size must be an integer, got 11\.0"):
        zh.losses.ssim(images(20, 20), window_size=11.0)


def test_without_kornia_the_package_to_install_is_named(monkeypatch) -> None:
    for module in ("kornia", "kornia.metrics"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"kornia .*pip install kornia"):
        zh.losses.ssim(images(20, 20))


def blob(x: torch.Tensor) -> np.ndarray:
    """Images [K, 16, 20] of a spot of width 0.2 at x [K, 2], in NumPy."""
    x, y = x.double().numpy()[:, :, None, None].swapaxes(0, 1)
    row, column = np.meshgrid(np.linspace(0, 1, 16), np.linspace(0, 1, 20), indexing="ij")
    return np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * 0.2**2))


@EACH
@pytest.mark.parametrize("inside", [False, True])
def test_minimize_with_the_loss_after_or_inside_the_black_box(name, inside) -> None:
    target = torch.tensor([[0.3, 0.6]], dtype=torch.float64)
    loss = FACTORIES[name](blob(target)[0])
    fn = (lambda x: loss(torch.from_numpy(blob(x)))) if inside else blob
    start = torch.tensor([0.7, 0.25])
    fit = zh.minimize(
        fn, start, sigma=0.2, loss=None if inside else loss, bounds=(0, 1), seed=0, max_evaluations=80, target=1e-7
    )
    assert fit.value < 1e-5
    assert torch.allclose(fit.x, target[0].float(), atol=5e-3)


@EACH
def test_a_network_learns_through_an_image_and_its_loss(name) -> None:
    """d loss(layer(x)) / dx = loss'(image) J, with the Jacobian J of the layer."""
    loss = FACTORIES[name](blob(torch.tensor([[0.3, 0.6]]))[0])
    layer = zh.BlackBox(blob, zh.Smoothing(sigma=0.1, samples=16, seed=0))
    x = torch.tensor([0.6, 0.4], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(layer(x)), x, create_graph=True)
    jacobian = torch.func.jacrev(layer)(x.detach())
    assert torch.allclose(gradient, torch.einsum("hwn,hw->n", jacobian, torch.func.grad(loss)(layer(x.detach()))))
    assert bool(torch.isfinite(torch.autograd.grad(gradient.sum(), x)[0]).all())


def test_a_target_that_is_no_image_is_named() -> None:
    with pytest.raises(TypeError, match=r"target must be an image \[h, w\] or \[h, w, c\], got NoneType"):
        zh.losses.mse(None)
