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
from dataclasses import asdict, replace
from pathlib import Path

import torch

import torch_zerohess as zh
from experiments.reports.result_files import keep, may_keep
from experiments.reports.tables import table
from experiments.runs.outputs import check_file
from experiments.runs.records import write
from experiments.studies.bench_ratios import Ratio, finished, hessian, in_turn, noise, redrawn, sampler
from torch_zerohess.sampling import proposals

_PROPOSALS = {"gaussian": proposals.GAUSSIAN, "aggregate": proposals.SECOND_ORDER}


def bench_device(
    *,
    device: str = "cuda",
    repeats: int = 51,
    n: int = 1 << 20,
    samples: int = 64,
    wide: int = 2048,
    out: Path | None = None,
    store: str | None = None,
) -> list[Ratio]:
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
    check_file(out)
    may_keep(store)
    rows = [
        row
        for dtype in (torch.float32, torch.float64)
        for name, proposal in _PROPOSALS.items()
        for row in _noise(dtype, repeats, n, samples, device, name, proposal)
    ]
    rows += [hessian(wide, repeats, device), redrawn(n, repeats, device), _layer(repeats, device)]
    where = torch.cuda.get_device_name() if device == "cuda" else device
    headers = [
        *("device", "operation", "compared with", "parameters", "samples"),
        *("package [us]", "compared [us]", "ratio"),
    ]
    cells: list[list[object]] = [
        [
            *(where, r.operation, r.compared_with, r.n, r.samples),
            *(round(1e6 * r.seconds, 1), round(1e6 * r.compared, 1), r.ratio),
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
) -> tuple[Ratio, Ratio]:
    against_randn = noise(dtype, repeats, n, samples, device, proposal)
    x, sigma = torch.zeros(1, n, dtype=dtype, device=device), torch.ones(n, dtype=torch.float64, device=device)
    empty = torch.empty(samples, n, dtype=dtype, device=device)
    seconds, compared = in_turn(
        sampler(x, sigma, samples, proposal), finished(lambda: empty.fill_(1.0), device), repeats
    )
    points = f"points, {str(dtype).removeprefix('torch.')}, {name}"
    return (
        replace(against_randn, operation=f"{against_randn.operation}, {name}"),
        Ratio(points, n, samples, seconds, compared, compared_with="fill"),
    )


def _layer(repeats: int, device: str) -> Ratio:
    samples = 8

    def on(where: str) -> Callable[[], object]:
        layer = zh.BlackBox(lambda z: z.sum(-1), zh.Smoothing(sigma=0.1, samples=samples))
        x = torch.zeros(2, device=where, requires_grad=True)
        return finished(lambda: torch.autograd.grad(layer(x), x), where)

    seconds, compared = in_turn(on(device), on("cpu"), repeats)
    return Ratio("layer: forward + backward", 2, samples, seconds, compared, compared_with="cpu")
