"""Black boxes with known minima for tests of searches, and how to run one."""

import math

import numpy as np
import torch
from scipy.optimize import linprog

from truths import normal, vector

TARGET = vector(3.0, -1.0)
CURVATURE = torch.tensor([[2.0, 0.6], [0.6, 5.0]], dtype=torch.float64)


def zeros(n, dtype=torch.float64):
    return torch.zeros(n, dtype=dtype)


def bowl(z):
    """A quadratic of condition 10 with minimum 0 at (3, -1, 3, -1, ...)."""
    z = z.double()
    center = TARGET.repeat(z.shape[1])[: z.shape[1]]
    return ((z - center) ** 2 * torch.linspace(1, 10, z.shape[1], dtype=torch.float64)).sum(1)


def tilted(z):
    """(z - TARGET)^T CURVATURE (z - TARGET) / 2 + 0.5."""
    y = z.double() - TARGET
    return (0.5 + 0.5 * ((y @ CURVATURE) * y).sum(1)).to(z.dtype)


def rosenbrock(z):
    """A curved valley with minimum 0 at (1, 1, ...)."""
    if z.shape[1] == 1:
        return (1 - z[:, 0]) ** 2
    return ((1 - z[:, :-1]) ** 2 + 10 * (z[:, 1:] - z[:, :-1] ** 2) ** 2).sum(1)


def plateau(z):
    """Constant but for a hole of radius 1."""
    return (z.square().sum(1) - 1).clamp_max(0.0)


def rays(z):
    """An output [2, 3] that is not linear; the same as a target only at 1."""
    k = torch.arange(1, 7, dtype=z.dtype)
    powers = z[:, None, :] * (1 + (torch.outer(k, torch.arange(1, z.shape[1] + 1, dtype=z.dtype)) % 5))
    return (powers.sum(2) + torch.sin(0.3 * powers).sum(2)).unflatten(1, (2, 3))


def rays_loss(n):
    """The loss of an output of `rays` for n parameters, 0 at 1."""
    target = rays(torch.ones(1, n, dtype=torch.float64))[0]
    return lambda output: (output - target).square().mean()


def bent(x):
    """Residuals [K, n + 2] whose sum of squares is 1 at its minimum 0, and curved there by the last residual."""
    k = torch.arange(1, x.shape[1] + 1, dtype=x.dtype)
    linear = (x + 0.3 * x.sum(1, keepdim=True)) / k
    return torch.cat([linear, (x * k).sum(1, keepdim=True), 1 + 0.5 * x.square().sum(1, keepdim=True)], 1)


def waves(x):
    """Smooth outputs [K, 5] of points [K, n]."""
    k = torch.arange(1, 6, dtype=torch.float64)
    return torch.sin(0.4 * k * x.sum(1, keepdim=True)) + 0.2 * k * x[:, :1]


def bar(z):
    """A picture [K, 40] with hard edges: a bar that is where z [K, 1] says, and nothing beyond the picture."""
    return ((torch.linspace(-6, 6, 40, dtype=torch.float64) - z[:, :1]).abs() < 1.0).double()


def bars(places):
    """Pictures [K, m] with hard edges of z [K, 2]: a bar around z[0] of a half width that grows with z[1]."""
    return lambda z: ((places - z[:, :1]).abs() < 0.2 + 0.1 * z[:, 1:]).double()


def bump(x):
    """A smooth picture [K, 40]: a bump that is where x [K, 1] says."""
    return torch.exp(-0.5 * ((torch.linspace(-6, 6, 40, dtype=torch.float64) - x[:, :1]) / 0.7).square())


def half_space(z, weight):
    """The minimum 3 of the distance to (1, 2, 3) is where x1 + x2 + x3 = 3."""
    return (z - vector(1.0, 2.0, 3.0)).square().sum(1) + weight * (z.sum(1) - 3).clamp(min=0)


def hyperbola(z, weight):
    """The minimum 2 of x1 + x2 is where x1 x2 = 1."""
    return z.sum(1) + weight * (1 - z[:, 0] * z[:, 1]).clamp(min=0)


def spiral(x):
    """Outputs [K, 2] of x [K, 1] whose loss has a local minimum in every turn."""
    return torch.cat([torch.sin(2 * x) + 0.25 * x, torch.cos(2 * x)], 1)


def well(z):
    """A loss [K] that is 1 but for a paraboloid around (2, -2), 4 % of the box [-4, 4]^2, and one near (-2.5, 1)."""
    narrow = (z - vector(2.0, -2.0)).square().sum(1) / 0.8
    shallow = 0.5 + (z - vector(-2.5, 1.0)).square().sum(1)
    return torch.minimum(torch.minimum(narrow, shallow), torch.ones(len(z), dtype=torch.float64))


def misfit(f, solution):
    """The mean square of an output of f against the one at the solution."""
    target = f(solution[None])[0]
    return lambda y: (y - target).square().mean()


def noisy(f, noise, seed):
    """Return f with normal noise of this standard deviation, other numbers at every call."""
    generator = torch.Generator().manual_seed(seed)
    return lambda z: f(z) + noise * torch.randn(len(z), generator=generator, dtype=torch.float64)


def run(search, f, evaluations, target=-math.inf, values=None):
    """Search until so many evaluations, or the target value; append the value after each batch to a list."""
    while not search.done and search.evaluations < evaluations and search.value > target:
        search.tell(f(search.ask(limit=evaluations - search.evaluations)))
        if values is not None:
            values.append(search.value)
    return search


def points_of(search, f, evaluations):
    """The points that a search asks for."""
    asked = []
    run(search, lambda z: f(asked.append(z) or z), evaluations)
    return torch.cat(asked)


def raising(fn, call, error=ZeroDivisionError):
    """Return fn, which raises an error in the given call of it (from 0)."""
    count = iter(range(call + 1))

    def counting(argument):
        if next(count) == call:
            raise error
        return fn(argument)

    return counting


SIDE = 12
N = SIDE**2


def square(target):
    """The mean square of the difference from a target."""
    return lambda y: (y - target).square().mean()


def sum_of_squares(target):
    """The sum of squares of the difference from a target."""
    return lambda y: (y - target).square().sum()


def texels(x):
    """Pixels [K, 12, 12] of one texel each."""
    return x.view(-1, SIDE, SIDE)


def cosine_bowl(z):
    """A wide bowl with its minimum beside 0 and local minima in every turn of cosines along the diagonals."""
    z = torch.stack([z[:, 0] + z[:, 1], z[:, 0] - z[:, 1]], 1) / 2**0.5
    return (0.01 * (z - 1.3).square() - torch.cos(3.0 * z)).sum(1)


KINKS = {
    "largest": lambda d: d.abs().max(),
    "mean": lambda d: d.abs().mean(),
    "curved": lambda d: d.abs().max() + 1e-9 * d.square().mean(),  # next to the largest one
}


class Linear:
    """Linear outputs [K, 3 n] of n parameters, whose loss may be least on sides of the box [-side, side]^n.

    The loss is the largest magnitude of differences from a target, or their mean. Its minimum is by linear programming.
    """

    def __init__(self, n, seed, kind, side=1.0):
        generator = torch.Generator().manual_seed(seed)
        self.a = torch.randn(3 * n, n, generator=generator).double()
        away = self.a @ (2 * torch.randn(n, generator=generator).double())
        self.target = away + 0.5 * torch.randn(3 * n, generator=generator).double()
        a, target, eye = self.a.numpy(), self.target.numpy(), np.eye(3 * n)
        beyond = eye if kind == "mean" else np.ones((3 * n, 1))
        cost = np.r_[np.zeros(n), np.full(beyond.shape[1], 1.0 / beyond.shape[1])]
        rows = np.block([[a, -beyond], [-a, -beyond]])
        box = [(-side, side)] * n + [(0, None)] * beyond.shape[1]
        self.least = linprog(cost, A_ub=rows, b_ub=np.r_[target, -target], bounds=box).fun
        self.loss = lambda y: KINKS[kind](y - self.target)

    def __call__(self, x):
        return x @ self.a.mT

    def excess(self, value):
        """Loss above the least one, over that of the start at zero."""
        return (value - self.least) / (float(self.loss(torch.zeros_like(self.target))) - self.least)


def hill_fit(seed):
    """Return an output of three parameters, its misfit to noisy data, a random start, and the box that it is in."""
    t = torch.linspace(0.0, 10.0, 50, dtype=torch.float64)
    lower, upper = vector(0.0, 0.1, 0.5), vector(6.0, 10.0, 10.0)

    def hill(x):
        return x[:, :1] * t ** x[:, 2:] / (x[:, 1:2] ** x[:, 2:] + t ** x[:, 2:])

    measured = hill(vector(2.0, 4.0, 3.0)[None])[0] + 0.02 * normal(50, seed=0)

    def loss(output):
        return 0.5 * ((output - measured) / 0.02).square().sum()

    start = torch.rand(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return hill, loss, lower + (upper - lower) * start, (lower, upper)
