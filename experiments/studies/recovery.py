"""How many samples determine a sparse Jacobian: ours, LASSO and least norm on the same samples of maps that are known.

Each of m outputs depends on s of n parameters. The samples are as in `zh.sparse_jacobian`, antithetic pairs: a pair
gives one difference along one direction. The support of s entries among n takes of the order of s log n differences
(Wainwright 2009). A second part draws a row and a column of the Jacobian of CAUSTIC beside finite differences.

LASSO is scikit-learn's. Its penalty is the one of `PENALTIES` that predicts a held-out quarter of the samples best, and
is then used on all of them.
"""

import math
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

import torch_zerohess as zh
from experiments.problems import catalogue
from experiments.problems.task import Task
from experiments.reports import result_files
from experiments.runs.outputs import check_folder

PENALTIES = (0.3, 0.1, 0.03, 0.01)
"""Of LASSO, in units of the smallest one that leaves no entry."""
_OUTPUTS = 256
_LIKELY = 0.99
"""Share of the entries at which a map counts as recovered."""
_REAL = 1e-3
"""Slope, over the smallest true one, that counts as an entry."""
HEADERS = ("method", "parameters", "entries", "pairs", "found", "false", "error", "seconds")


@dataclass(frozen=True)
class Recovery:
    """What a method finds of one map."""

    method: str
    n: int
    entries: int
    """Of every row."""
    pairs: int
    """Antithetic: two evaluations each."""
    found: float
    """Share of the true entries that are among the `entries` largest of their row."""
    false: float
    """Share of the entries that are found and are none; NaN for least norm, which leaves nothing out."""
    error: float
    """Of the Jacobian, relative to its Frobenius norm."""
    seconds: float


def recovery(
    n: tuple[int, ...] = (64, 256, 1024),
    entries: int = 4,
    pairs: tuple[int, ...] = (16, 24, 32, 48, 64, 96, 128),
    seed: int = 0,
    lasso: bool = True,
    out: Path = Path("results/recovery"),
    store: str | None = None,
) -> list[Recovery]:
    """Print and draw how much of sparse Jacobians is found from how many samples.

    Args:
        n: parameters.
        entries: of every row.
        pairs: antithetic pairs of samples.
        seed: of maps and samples.
        lasso: whether scikit-learn's LASSO gets the same samples.
        out: folder of the figures.
        store: name under which the table is kept.
    """
    if not n or not pairs or min(n) <= entries or min(pairs) < 16 or entries < 1:
        raise SystemExit(f"n must exceed entries, and pairs be at least 16, got {n}, {entries} and {pairs}")
    result_files.may_keep(store)
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    rows = [row for size in n for count in pairs for row in compared(size, entries, count, seed, lasso)]
    result_files.show(HEADERS, [list(astuple(row)) for row in rows], store)
    for size in n:
        counts = [row.pairs for row in rows if (row.method, row.n) == ("ours", size) and row.found >= _LIKELY]
        told = f"{min(counts)} pairs" if counts else f"more than {max(pairs)} pairs"
        print(f"n = {size}: {told}; s ln n = {entries * math.log(size):.0f}")
    drawn = draw_jacobian(catalogue.fitting("caustic"), out / "jacobian.png", seed=seed)
    for path in (_draw_curves(rows, out / "recovery.png"), drawn):
        print(path)
    return rows


def compared(n: int, entries: int, pairs: int, seed: int, lasso: bool) -> list[Recovery]:
    """Return what each method finds of a map of n parameters from so many pairs."""
    generator = torch.Generator().manual_seed(seed + n)
    truth = torch.zeros(_OUTPUTS, n, dtype=torch.float64)
    for row in truth:
        signs = torch.randint(2, (entries,), generator=generator) * 2 - 1
        sizes = 1 + torch.rand(entries, generator=generator, dtype=torch.float64)
        row[torch.randperm(n, generator=generator)[:entries]] = signs * sizes
    seen: list[tuple[Tensor, Tensor]] = []

    def image(z: Tensor) -> Tensor:
        seen.append((z, z @ truth.mT))
        return seen[-1][1]

    smoothing = zh.Smoothing(sigma=1.0, samples=pairs, proposal="gaussian", seed=seed)
    ways: dict[str, Callable[[], Tensor]] = {
        "ours": lambda: zh.sparse_jacobian(image, torch.zeros(n).double(), smoothing, keep=2 * entries).dense()
    }

    def differences() -> tuple[Tensor, Tensor]:
        points, values = ((one[:pairs] - one[pairs:]) / 2 for one in seen[0])
        return points, values

    ways["least norm"] = lambda: torch.linalg.lstsq(*differences(), driver="gelsd").solution.mT
    if lasso:
        ways["LASSO"] = lambda: _lasso(*differences())
    rows = []
    for name, way in ways.items():
        began = time.process_time()
        found = way()
        seconds = time.process_time() - began
        largest = found.abs().topk(entries, dim=1).indices
        hit = truth.gather(1, largest) != 0
        there = found.abs() > _REAL
        false = float((there & (truth == 0)).sum() / there.sum().clamp_min(1))
        error = float((found - truth).norm() / truth.norm())
        share = math.nan if name == "least norm" else false
        rows.append(Recovery(name, n, entries, pairs, float(hit.double().mean()), share, error, seconds))
    return rows


def _lasso(u: Tensor, changes: Tensor) -> Tensor:
    """Return the Jacobian [m, n] of changes [K, m] along u [K, n] by LASSO, with the penalty that predicts best."""
    from sklearn.linear_model import Lasso

    held = max(1, len(u) // 4)

    def fitted(penalty: float, x: Tensor, y: Tensor) -> Tensor:
        largest = float((x.mT @ y).abs().max()) / len(x)
        model = Lasso(alpha=penalty * largest, fit_intercept=False, max_iter=5000)
        return torch.from_numpy(model.fit(x.numpy(), y.numpy()).coef_)

    def missed(penalty: float) -> float:
        slopes = fitted(penalty, u[held:], changes[held:])
        return float((changes[:held] - u[:held] @ slopes.mT).square().sum())

    return fitted(min(PENALTIES, key=missed), u, changes)


def _draw_curves(rows: list[Recovery], path: Path) -> Path:
    """Draw the share of entries found against pairs over s ln n: curves of all n fall together."""
    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    styles = {"ours": "-", "LASSO": "--", "least norm": ":"}
    sizes = list(dict.fromkeys(row.n for row in rows))
    for (name, style), (k, size) in ((a, b) for a in styles.items() for b in enumerate(sizes)):
        some = [row for row in rows if (row.method, row.n) == (name, size)]
        if some:
            unit = some[0].entries * math.log(size)
            label = f"{name}, n = {size}"
            axes.plot(
                [row.pairs / unit for row in some], [row.found for row in some], style, color=f"C{k}", label=label
            )
    axes.set(xlabel="pairs / (s ln n)", ylabel="share of entries found", ylim=(0, 1.05))
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=120, bbox_inches="tight")
    return path


def draw_jacobian(task: Task, path: Path, *, samples: int = 128, seed: int = 0) -> Path:
    """Draw a row and a column of a task's Jacobian as images: by finite differences, and from samples.

    The parameters lie on a square grid, and the output is an image [h, w].
    """
    assert task.output is not None
    image, x, side = task.output.image, task.start(seed).double(), math.isqrt(task.n)
    steps = 0.1 * task.sigma * torch.eye(task.n, dtype=torch.float64)
    central = [(image(x + part) - image(x - part)).flatten(1) for part in steps.split(64)]
    exact = torch.cat(central).mT / (0.2 * task.sigma)
    smoothing = zh.Smoothing(sigma=task.sigma, samples=samples, seed=seed)
    found = zh.sparse_jacobian(image, x, smoothing, grid=(side, side))
    sampled = found.dense().view_as(exact)
    height = found.shape[0]
    pixel, parameter = (height // 2) * found.shape[1] + found.shape[1] // 2, (side // 2) * side + side // 2
    figure = Figure(figsize=(6, 6), layout="constrained")
    axes = figure.subplots(2, 2)
    for column, jacobian in enumerate((exact, sampled)):
        for row, part, whole in ((0, jacobian[pixel], exact[pixel]), (1, jacobian[:, parameter], exact[:, parameter])):
            most, shape = float(whole.abs().max()), (side, side) if row == 0 else tuple(found.shape)
            axes[row, column].imshow(part.view(shape).numpy(), cmap="RdBu", vmin=-most, vmax=most)
            axes[row, column].set(xticks=[], yticks=[])
    axes[0, 0].set(title=f"finite differences, {2 * task.n} evaluations", ylabel="what a pixel depends on")
    axes[0, 1].set(title=f"from samples, {found.evaluations} evaluations")
    axes[1, 0].set(ylabel="what a parameter changes")
    cosine = float((exact * sampled).sum() / (exact.norm() * sampled.norm()))
    figure.suptitle(f"Jacobian of {task.name.upper()}, cosine {cosine:.2f}")
    figure.savefig(path, dpi=120)
    return path
