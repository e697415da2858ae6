"""Least-squares problems of Moré, Garbow and Hillstrom (1981): residuals [K, n] -> [K, m], standard starts, minima."""

import torch

from truths import vector


def rosenbrock(x):
    return torch.stack([10 * (x[:, 1] - x[:, 0] ** 2), 1 - x[:, 0]], 1)


def helical_valley(x):
    angle = torch.atan2(x[:, 1], x[:, 0]) / (2 * torch.pi)
    radius = x[:, :2].norm(dim=1)
    return torch.stack([10 * (x[:, 2] - 10 * angle), 10 * (radius - 1), x[:, 2]], 1)


def powell_singular(x):
    a, b, c, d = x.mT
    return torch.stack([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2], 1)


def brown_dennis(x):
    t = torch.arange(1, 21, dtype=torch.float64) / 5
    a, b, c, d = x.mT[:, :, None]
    return (a + t * b - t.exp()) ** 2 + (c + d * t.sin() - t.cos()) ** 2


def chebyquad(x):
    """Means of shifted Chebyshev polynomials; for n = 6 to 8 and 10 the residual of the minimum is not always zero."""
    n = x.shape[1]
    y = 2 * x - 1
    before, now, rows = torch.ones_like(y), y, []
    for i in range(1, n + 1):
        rows.append(now.mean(1) + (1 / (i * i - 1) if i % 2 == 0 else 0.0))
        before, now = now, 2 * y * now - before
    return torch.stack(rows, 1)


OSBORNE_1 = vector(
    *(0.844, 0.908, 0.932, 0.936, 0.925, 0.908, 0.881, 0.850, 0.818, 0.784, 0.751, 0.718, 0.685, 0.658, 0.628, 0.603),
    *(0.580, 0.558, 0.538, 0.522, 0.506, 0.490, 0.478, 0.467, 0.457, 0.448, 0.438, 0.431, 0.424, 0.420, 0.414, 0.411),
    0.406,
)


def osborne_1(x):
    t = 10 * torch.arange(33, dtype=torch.float64)
    a, b, c, d, e = x.mT[:, :, None]
    return OSBORNE_1 - (a + b * (-d * t).exp() + c * (-e * t).exp())


PROBLEMS = {
    "rosenbrock": (rosenbrock, vector(-1.2, 1.0), 0.0),
    "helical_valley": (helical_valley, vector(-1.0, 0.0, 0.0), 0.0),
    "powell_singular": (powell_singular, vector(3.0, -1.0, 0.0, 1.0), 0.0),
    "brown_dennis": (brown_dennis, vector(25.0, 5.0, -5.0, -1.0), 85822.2),
    "osborne_1": (osborne_1, vector(0.5, 1.5, -1.0, 0.01, 0.02), 5.46489e-5),
    "chebyquad_6": (chebyquad, torch.arange(1, 7, dtype=torch.float64) / 7, 0.0),
    "chebyquad_8": (chebyquad, torch.arange(1, 9, dtype=torch.float64) / 9, 3.51687e-3),
}
"""Residuals, start and the lowest sum of squares by name."""
