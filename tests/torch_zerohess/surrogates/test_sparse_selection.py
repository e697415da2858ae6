"""Correlations of large images with many parameters: in tiles, against all of them at once."""

import pytest
import torch

from torch_zerohess.surrogates import sparse_selection
from torch_zerohess.surrogates.sparse_selection import Grids, Thresholds, candidates, thresholds
from truths import normal


def centered(x):
    return x - x.mean(0)


def all_candidates(u, d, pixels, grid, least):
    """Sizes of the pairs that count, else 0, [m, n]: from all correlations and means of torch's pooling."""
    r = (d / d.norm(dim=0)).mT @ (u / u.norm(dim=0))
    squares, m, n = r.square(), d.shape[1], u.shape[1]
    pool = torch.nn.AvgPool2d(3, 1, 1, count_include_pad=False)
    mean = pool(squares.view(1, *pixels, n).movedim(3, 1)).movedim(1, 3)
    if grid is not None:
        mean = pool(mean.reshape(m, 1, *grid))
    own, joint = squares * (squares >= least.own), mean.reshape(m, n)
    strength = torch.maximum(own, joint * (joint >= least.joint))
    return strength.sqrt() * d.norm(dim=0)[:, None] / u.norm(dim=0)


@pytest.mark.parametrize("grid", [None, (30, 30)])
@pytest.mark.parametrize("pixels", [(40, 20), (9, 100)])
def test_candidates_are_those_of_all_correlations(pixels, grid):
    """The image and the parameters are cut into tiles, whose edges are in the middle of them."""
    m = pixels[0] * pixels[1]
    u = centered(normal(24, 900, seed=1))
    d = centered(u[:, torch.arange(m) % 900] + 2 * normal(24, m, seed=2))
    least, grids = (
        Thresholds(0.4, 0.12 if grid is None else 0.07),
        Grids((*pixels, 1), None if grid is None else (*grid, 1)),
    )
    parts = [(element + block.start, *rest) for block, element, *rest in candidates(u, d, grids, least)]
    element, parameter, size = (torch.cat([one[k] for one in parts]) for k in range(3))
    found = torch.zeros(m, 900).double().index_put_((element, parameter), size, accumulate=True)
    expected = all_candidates(u, d, pixels, grid, least)
    assert len(parts) > 1
    assert 500 < len(element) < 50_000
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_tiles_are_small_and_overlap_little(monkeypatch):
    """A tile has about 2^18 pairs with its neighbours, and all tiles less than 40 % more than all pairs."""
    sizes, mean = [], Grids.mean
    monkeypatch.setattr(Grids, "mean", lambda grids, one: sizes.append(one.numel()) or mean(grids, one))
    u, d = centered(normal(9, 3600).float()), centered(normal(9, 2700, seed=1).float())
    for grid in (None, (60, 60, 1)):
        sizes.clear()
        list(candidates(u, d, Grids((90, 30, 1), grid), Thresholds(0.99, 0.99)))
        assert max(sizes) <= 2 << 18
        assert sum(sizes) <= 1.4 * 2700 * 3600
        assert len(sizes) < 100
    # Rows of this image are longer than the side of a tile: a tile has eight of them none the less.
    sizes.clear()
    wide = centered(normal(9, 24 * 600, seed=1).float())
    list(candidates(u[:, :900], wide, Grids((24, 600, 1), (30, 30, 1)), Thresholds(0.99, 0.99)))
    assert sum(sizes) <= 1.5 * 24 * 600 * 900


def test_thresholds_of_large_images_are_those_of_all_pairs(monkeypatch):
    """A row of this image has more pairs than a block holds. Means are over 3x3 pixels none the less."""
    u = centered(normal(24, 3000, seed=1).float())
    patches = u[:, : 2 * 134].view(24, 2, 134).repeat_interleave(3, 1).repeat_interleave(3, 2)[:, :, :400]
    d = patches.flatten(1) + 1.5 * normal(24, 2400, seed=2).float()
    grids = Grids((6, 400, 1))
    few = thresholds(u, centered(d), grids, 0.1)
    monkeypatch.setattr(sparse_selection, "_BLOCK", 1 << 30)
    monkeypatch.setattr(sparse_selection, "_COUNTED", 1 << 30)
    every = thresholds(u, centered(d), grids, 0.1)
    assert every.joint < 1.0
    assert few.joint == pytest.approx(every.joint, rel=0.15)


@pytest.mark.parametrize(
    ("shape", "pixels"),
    [
        ((60,), (60, 1, 1)),
        ((6, 10), (6, 10, 1)),
        ((6, 10, 4), (6, 10, 4)),
        ((3, 6, 10), (18, 10, 1)),
        ((2, 6, 10, 3), (12, 10, 3)),
        ((2, 3, 6, 10), (36, 10, 1)),
        ((60, 1), (60, 1, 1)),
    ],
)
def test_the_layout_of_an_image_is_read_from_its_shape(shape, pixels):
    assert Grids.of(torch.Size(shape), None).pixels == pixels


def test_an_output_beyond_float32_does_not_stop_the_others():
    u, rest = normal(40, 20).float(), normal(40, 20, seed=1).float()
    rest[:, 3] = torch.inf
    rest[:, 5] = u[:, 5]
    least = thresholds(u, rest, Grids.of(torch.Size([20]), None), 0.01)
    assert least.own < 1.0


def test_few_pairs_count_and_chance_alone_does_not():
    """Of 200 outputs of pure noise at most a tenth should have any pair: 40 is more than four standard errors more."""
    generator, some = torch.Generator().manual_seed(0), 0
    grids = Grids.of(torch.Size([3]), None)
    for _ in range(200):
        u, noise = (centered(torch.randn(60, k, generator=generator)) for k in (150, 3))
        some += bool(len(next(candidates(u, noise, grids, thresholds(u, noise, grids, 0.1)))[1]))
    assert some < 40
    found = list(candidates(u, u[:, :3], grids, thresholds(u, u[:, :3], grids, 0.1)))
    assert {(0, 0), (1, 1), (2, 2)} <= {
        pair for one in found for pair in zip(one[1].tolist(), one[2].tolist(), strict=True)
    }


def test_changes_whose_squares_vanish_have_the_correlations_of_larger_ones():
    """The rest of a fit may be 1e-30 in float32: r^2 was far above 1 there, and could not be counted."""
    u, rest = centered(normal(60, 6)).float(), centered(normal(60, 30)).float()
    grids = Grids((30, 1, 1))
    expected, found = (thresholds(u, scale * rest, grids, 0.1) for scale in (1.0, 1e-30))
    assert found.own == pytest.approx(expected.own, rel=1e-5)
