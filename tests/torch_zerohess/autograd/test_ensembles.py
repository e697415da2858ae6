"""Networks of equal shapes as one call: `torch.func.vmap` of `functional_call`, with stacked parameters."""

import copy

import torch

import torch_zerohess as zh

SIGMA = 0.3


class Squares(torch.nn.Module):
    """The smoothed sum of squares of the outputs of a linear layer, |y|^2 + 2 sigma^2."""

    def __init__(self, sigma: float, seed: int | None = None) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(3, 2, dtype=torch.float64)
        smoothing = zh.Smoothing(sigma=sigma, samples=256, seed=seed)
        self.layer = zh.BlackBox(lambda z: z.square().sum(1), smoothing, value="smoothed")

    def forward(self, x):
        return self.layer(self.linear(x))


def losses(members, x):
    """Return the losses [members, len(x)] of one call, through the layer of a copy of the first member."""
    one = copy.deepcopy(members[0]).to("meta")
    stacked = torch.func.stack_module_state(members)
    return torch.func.vmap(lambda state: torch.func.functional_call(one, state, (x,)))(stacked)


def test_members_have_parameters_of_their_own_and_the_sigma_of_the_module_that_is_called():
    """The smoothed value tells which sigma: its part 2 sigma^2 would be 2 for the second member's own."""
    torch.manual_seed(0)
    members, x = [Squares(SIGMA), Squares(1.0)], 0.1 * torch.randn(64, 3, dtype=torch.float64)
    found = losses(members, x)
    truth = torch.stack([one.linear(x).square().sum(1) + 2 * SIGMA**2 for one in members])
    torch.testing.assert_close(found.mean(1), truth.mean(1), rtol=0.02, atol=0)


def test_members_have_independent_noise():
    """Members with equal parameters at one x, even with a seed."""
    torch.manual_seed(0)
    one = Squares(SIGMA, seed=0)
    x = torch.ones(1, 3, dtype=torch.float64)
    found = losses([one, copy.deepcopy(one), copy.deepcopy(one)], x)
    assert len(set(found.flatten().tolist())) == 3
