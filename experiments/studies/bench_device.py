"""The package on a CUDA device, against what the device can do: times as ratios, measured in turn in one run.

| row | measured | compared with |
|---|---|---|
| noise | picks, perturbations, points and density ratios of one batch | `torch.randn` of the same count |
| points | the same | writing as many numbers, by `fill_`: the bandwidth of the memory |
| Hessian | `Estimate.hessian` | the bare matrix product of its samples |
| gradient + HVP | one gradient and one product from perturbations that are drawn again | three passes of noise |
| layer | forward and backward with a black box that costs nothing | the same on the processor |

A ratio above 1 says that the package is faster.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

import torch_zerohess as zh
from experiments.reports.result_files import keep, may_keep
from experiments.reports.tables import table
from experiments.runs.records import write
from experiments.studies.bench_ratios import finished, hessian, in_turn, noise, redrawn, sampler
from torch_zerohess.sampling import proposals

_PROPOSALS = {"gaussian": proposals.GAUSSIAN, "aggregate": proposals.SECOND_ORDER}


@dataclass(frozen=True)
class Row:
    """Median seconds of a measured operation and of what it is compared with."""

    operation: str
    compared_with: str
    n: int
    samples: int
    seconds: float
    compared: float

    @property
    def ratio(self) -> float:
        """How many times faster the package is."""
        return self.compared / self.seconds


def bench_device(
    *,
    device: str = "cuda",
    repeats: int = 51,
    n: int = 1 << 20,
    samples: int = 64,
    wide: int = 2048,
    out: Path | None = None,
    store: str | None = None,
) -> list[Row]:
    """Time noise, sums and the layer on a CUDA device against `torch.randn`, its memory and matrix products.

    Args:
        device: where the tensors are: cuda, or cpu.
        repeats: timings of which the median is reported.
        n: parameters of the noise and of the sums.
        samples: rows of the noise.
        wide: parameters of the Hessian.
        out: JSON file to write.
        store: name of the table that is kept under experiments/results, for the documents.
    """
    if device not in ("cuda", "cpu"):
        raise SystemExit(f"device must be cuda or cpu, got {device}")
    if device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("device is cuda, but torch finds none: zh.doctor() lists the devices")
    for name, value in {"repeats": repeats, "n": n, "samples": samples, "wide": wide}.items():
        if value < 1:
            raise SystemExit(f"{name} must be at least 1, got {value}")
    if store is not None:
        may_keep(store)
    rows = [
        row
        for dtype in (torch.float32, torch.float64)
        for name, proposal in _PROPOSALS.items()
        for row in _noise(dtype, repeats, n, samples, device, name, proposal)
    ]
    for one, reference in ((hessian(wide, repeats, device), "matrix product"), (redrawn(n, repeats, device), "noise")):
        rows.append(Row(one.operation, reference, one.n, one.samples, one.seconds, one.compared))
    rows.append(_layer(repeats, device))
    where = torch.cuda.get_device_name() if device == "cuda" else device
    headers = [
        "device",
        "operation",
        "compared with",
        "parameters",
        "samples",
        "package [us]",
        "compared [us]",
        "ratio",
    ]
    cells: list[list[object]] = [
        [
            where,
            r.operation,
            r.compared_with,
            r.n,
            r.samples,
            round(1e6 * r.seconds, 1),
            round(1e6 * r.compared, 1),
            r.ratio,
        ]
        for r in rows
    ]
    print(table(headers, cells))
    if out is not None:
        write(out, json.dumps([{**asdict(r), "ratio": r.ratio, "device": where} for r in rows], indent=1))
    if store is not None:
        print(keep(headers, cells, store))
    return rows


def _noise(
    dtype: torch.dtype, repeats: int, n: int, samples: int, device: str, name: str, proposal: int
) -> tuple[Row, Row]:
    against_randn = noise(dtype, repeats, n, samples, device, proposal)
    x, sigma = torch.zeros(1, n, dtype=dtype, device=device), torch.ones(n, dtype=torch.float64, device=device)
    empty = torch.empty(samples, n, dtype=dtype, device=device)
    seconds, compared = in_turn(
        sampler(x, sigma, samples, proposal), finished(lambda: empty.fill_(1.0), device), repeats
    )
    return (
        Row(f"{against_randn.operation}, {name}", "randn", n, samples, against_randn.seconds, against_randn.compared),
        Row(f"points, {str(dtype).removeprefix('torch.')}, {name}", "fill", n, samples, seconds, compared),
    )


def _layer(repeats: int, device: str) -> Row:
    samples = 8

    def on(where: str) -> Callable[[], object]:
        layer = zh.BlackBox(lambda z: z.sum(-1), zh.Smoothing(sigma=0.1, samples=samples))
        x = torch.zeros(2, device=where, requires_grad=True)
        return finished(lambda: torch.autograd.grad(layer(x), x), where)

    seconds, compared = in_turn(on(device), on("cpu"), repeats)
    return Row("layer: forward + backward", "cpu", 2, samples, seconds, compared)
