"""22 functions whose squared residuals are sought to be small, most of them of More, Garbow and Hillstrom 1981."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

_BARD = (0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39)
_KOWALIK_V = (4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625)
_KOWALIK = (0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246)
_MEYER = (*(34780, 28610, 23650, 19630, 16370, 13720, 11540, 9744, 8261, 7030, 6005, 5147, 4427, 3820, 3307, 2872),)
_OSBORNE_1 = (
    *(0.844, 0.908, 0.932, 0.936, 0.925, 0.908, 0.881, 0.850, 0.818, 0.784, 0.751, 0.718, 0.685, 0.658, 0.628, 0.603),
    *(0.580, 0.558, 0.538, 0.522, 0.506, 0.490, 0.478, 0.467, 0.457, 0.448, 0.438, 0.431, 0.424, 0.420, 0.414, 0.411),
    0.406,
)
_OSBORNE_2 = (
    *(1.366, 1.191, 1.112, 1.013, 0.991, 0.885, 0.831, 0.847, 0.786, 0.725, 0.746, 0.679, 0.608, 0.655, 0.616, 0.606),
    *(0.602, 0.626, 0.651, 0.724, 0.649, 0.649, 0.694, 0.644, 0.624, 0.661, 0.612, 0.558, 0.533, 0.495, 0.500, 0.423),
    *(0.395, 0.375, 0.372, 0.391, 0.396, 0.405, 0.428, 0.429, 0.523, 0.562, 0.607, 0.653, 0.672, 0.708, 0.633, 0.668),
    *(0.645, 0.632, 0.591, 0.559, 0.597, 0.625, 0.739, 0.710, 0.729, 0.720, 0.636, 0.581, 0.428, 0.292, 0.162, 0.098),
    0.054,
)


def _count(m: int) -> Tensor:
    """Return 1, 2, ..., m."""
    return torch.arange(1, m + 1, dtype=torch.float64)


def _data(values: tuple[float, ...]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _linear_full_rank(x: Tensor, m: int) -> Tensor:
    rest = (-2.0 * x.sum(1, keepdim=True) / m - 1.0).expand(-1, m)
    return rest + torch.nn.functional.pad(x, (0, m - x.shape[1]))


def _linear_rank_one(x: Tensor, m: int) -> Tensor:
    return (x @ _count(x.shape[1]))[:, None] * _count(m) - 1.0


def _linear_rank_one_with_zeros(x: Tensor, m: int) -> Tensor:
    slope = _count(m) - 1.0
    slope[-1] = 0.0
    return (x[:, 1:-1] @ _count(x.shape[1])[1:-1])[:, None] * slope - 1.0


def _rosenbrock(x: Tensor, m: int) -> Tensor:
    return torch.stack([10.0 * (x[:, 1] - x[:, 0] ** 2), 1.0 - x[:, 0]], 1)


def _helical_valley(x: Tensor, m: int) -> Tensor:
    angle = torch.atan(x[:, 1] / x[:, 0]) / (2.0 * math.pi) + 0.5 * (x[:, 0] < 0)
    angle = torch.where(x[:, 0] == 0, 0.25 * x[:, 1].sign(), angle)
    return torch.stack([10.0 * (x[:, 2] - 10.0 * angle), 10.0 * (x[:, :2].norm(dim=1) - 1.0), x[:, 2]], 1)


def _powell_singular(x: Tensor, m: int) -> Tensor:
    a, b, c, d = x.T
    return torch.stack([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2], 1)


def _freudenstein_roth(x: Tensor, m: int) -> Tensor:
    a, b = x.T
    return torch.stack([-13 + a + ((5 - b) * b - 2) * b, -29 + a + ((1 + b) * b - 14) * b], 1)


def _bard(x: Tensor, m: int) -> Tensor:
    u, v = _count(15), 16.0 - _count(15)
    return _data(_BARD) - (x[:, :1] + u / (x[:, 1:2] * v + x[:, 2:] * torch.minimum(u, v)))


def _kowalik_osborne(x: Tensor, m: int) -> Tensor:
    v = _data(_KOWALIK_V)
    return _data(_KOWALIK) - x[:, :1] * (v**2 + v * x[:, 1:2]) / (v**2 + v * x[:, 2:3] + x[:, 3:])


def _meyer(x: Tensor, m: int) -> Tensor:
    return x[:, :1] * (x[:, 1:2] / (45.0 + 5.0 * _count(16) + x[:, 2:])).exp() - _data(_MEYER)


def _watson(x: Tensor, m: int) -> Tensor:
    n, t = x.shape[1], _count(29)[:, None] / 29.0
    powers = t ** torch.arange(n, dtype=torch.float64)
    slopes = torch.arange(1, n, dtype=torch.float64) * powers[:, :-1]
    first = x[:, 1:] @ slopes.T - (x @ powers.T) ** 2 - 1.0
    return torch.cat([first, x[:, :1], x[:, 1:2] - x[:, :1] ** 2 - 1.0], 1)


def _box_3d(x: Tensor, m: int) -> Tensor:
    t = _count(m) / 10.0
    return (-t * x[:, :1]).exp() - (-t * x[:, 1:2]).exp() + ((-10.0 * t).exp() - (-t).exp()) * x[:, 2:]


def _jennrich_sampson(x: Tensor, m: int) -> Tensor:
    i = _count(m)
    return 2.0 + 2.0 * i - (i * x[:, :1]).exp() - (i * x[:, 1:]).exp()


def _brown_dennis(x: Tensor, m: int) -> Tensor:
    t = _count(m) / 5.0
    one, other = x[:, :1] + t * x[:, 1:2] - t.exp(), x[:, 2:3] + t.sin() * x[:, 3:] - t.cos()
    return one**2 + other**2


def _chebyquad(x: Tensor, m: int) -> Tensor:
    y = 2.0 * x - 1.0
    before, now, rows = torch.ones_like(y), y, []
    for i in range(1, m + 1):
        rows.append(now.mean(1) + (1.0 / (i * i - 1.0) if i % 2 == 0 else 0.0))
        before, now = now, 2.0 * y * now - before
    return torch.stack(rows, 1)


def _brown_almost_linear(x: Tensor, m: int) -> Tensor:
    n = x.shape[1]
    return torch.cat([x[:, :-1] + x.sum(1, keepdim=True) - (n + 1.0), x.prod(1, keepdim=True) - 1.0], 1)


def _osborne_1(x: Tensor, m: int) -> Tensor:
    t = 10.0 * (_count(33) - 1.0)
    return _data(_OSBORNE_1) - (x[:, :1] + x[:, 1:2] * (-x[:, 3:4] * t).exp() + x[:, 2:3] * (-x[:, 4:] * t).exp())


def _osborne_2(x: Tensor, m: int) -> Tensor:
    t = (_count(65) - 1.0) / 10.0
    peaks = x[:, :1] * (-t * x[:, 4:5]).exp()
    for k in range(3):
        peaks = peaks + x[:, k + 1, None] * (-((t - x[:, k + 8, None]) ** 2) * x[:, k + 5, None]).exp()
    return _data(_OSBORNE_2) - peaks


def _bdqrtic(x: Tensor, m: int) -> Tensor:
    n = x.shape[1]
    parts = [(k + 1.0) * x[:, k : n - 4 + k] ** 2 for k in range(4)]
    return torch.cat([3.0 - 4.0 * x[:, : n - 4], torch.stack(parts).sum(0) + 5.0 * x[:, -1:] ** 2], 1)


def _cube(x: Tensor, m: int) -> Tensor:
    return torch.cat([x[:, :1] - 1.0, 10.0 * (x[:, 1:] - x[:, :-1] ** 3)], 1)


def _mancino_terms(x: Tensor) -> Tensor:
    n = x.shape[1]
    v = (x[:, :, None] ** 2 + _count(n)[:, None] / _count(n)).sqrt()
    log = v.log()
    return (_count(n) - 50.0) ** 3 + (v * (log.sin() ** 5 + log.cos() ** 5)).sum(2)


def _mancino(x: Tensor, m: int) -> Tensor:
    return 1400.0 * x + _mancino_terms(x)


def _heart(x: Tensor, m: int) -> Tensor:
    a, b, c, d, t, u, v, w = x.T
    rows = [
        a + b + 0.69,
        c + d + 0.044,
        t * a + u * b - v * c - w * d + 1.57,
        v * a + w * b + t * c + u * d + 1.31,
        a * (t**2 - v**2) - 2 * c * t * v + b * (u**2 - w**2) - 2 * d * u * w + 2.65,
        c * (t**2 - v**2) + 2 * a * t * v + d * (u**2 - w**2) + 2 * b * u * w - 2.0,
        a * t * (t**2 - 3 * v**2)
        + c * v * (v**2 - 3 * t**2)
        + b * u * (u**2 - 3 * w**2)
        + d * w * (w**2 - 3 * u**2)
        + 12.6,
        c * t * (t**2 - 3 * v**2)
        - a * v * (v**2 - 3 * t**2)
        + d * u * (u**2 - 3 * w**2)
        - b * w * (w**2 - 3 * u**2)
        - 9.48,
    ]
    return torch.stack(rows, 1)


@dataclass(frozen=True)
class Function:
    """Residuals, and where searches usually start."""

    residuals: Callable[[Tensor, int], Tensor]
    """Points [K, n] and the number m of residuals -> residuals [K, m]."""
    start: Callable[[int], Tensor]
    """n -> [n]."""


def _at(*start: float) -> Callable[[int], Tensor]:
    return lambda n: _data(start)


def _all(value: float) -> Callable[[int], Tensor]:
    return lambda n: torch.full((n,), value, dtype=torch.float64)


FUNCTIONS = {
    "linear_full_rank": Function(_linear_full_rank, _all(1.0)),
    "linear_rank_one": Function(_linear_rank_one, _all(1.0)),
    "linear_rank_one_with_zeros": Function(_linear_rank_one_with_zeros, _all(1.0)),
    "rosenbrock": Function(_rosenbrock, _at(-1.2, 1.0)),
    "helical_valley": Function(_helical_valley, _at(-1.0, 0.0, 0.0)),
    "powell_singular": Function(_powell_singular, _at(3.0, -1.0, 0.0, 1.0)),
    "freudenstein_roth": Function(_freudenstein_roth, _at(0.5, -2.0)),
    "bard": Function(_bard, _all(1.0)),
    "kowalik_osborne": Function(_kowalik_osborne, _at(0.25, 0.39, 0.415, 0.39)),
    "meyer": Function(_meyer, _at(0.02, 4000.0, 250.0)),
    "watson": Function(_watson, _all(0.5)),  # zero in More, Garbow and Hillstrom
    "box_3d": Function(_box_3d, _at(0.0, 10.0, 20.0)),
    "jennrich_sampson": Function(_jennrich_sampson, _at(0.3, 0.4)),
    "brown_dennis": Function(_brown_dennis, _at(25.0, 5.0, -5.0, -1.0)),
    "chebyquad": Function(_chebyquad, lambda n: _count(n) / (n + 1.0)),
    "brown_almost_linear": Function(_brown_almost_linear, _all(0.5)),
    "osborne_1": Function(_osborne_1, _at(0.5, 1.5, 1.0, 0.01, 0.02)),
    "osborne_2": Function(_osborne_2, _at(1.3, 0.65, 0.65, 0.7, 0.6, 3.0, 5.0, 7.0, 2.0, 4.5, 5.5)),
    "bdqrtic": Function(_bdqrtic, _all(1.0)),
    "cube": Function(_cube, _all(0.5)),
    "mancino": Function(_mancino, lambda n: -8.710996e-4 * _mancino_terms(torch.zeros(1, n, dtype=torch.float64))[0]),
    "heart": Function(_heart, _at(-0.3, -0.39, 0.3, -0.344, -1.2, 2.69, 1.59, -1.5)),
}
