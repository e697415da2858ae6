"""The study of sparse Jacobians, run small: the entries found are compared with known maps."""

import math
from dataclasses import replace

import pytest
import small
import torch
from matplotlib.axes import Axes

from experiments.problems.task import Output
from experiments.reports.tables import table
from experiments.studies import recovery
from experiments.studies.recovery import HEADERS, compared, draw_jacobian


def test_all_entries_are_found_where_least_norm_finds_some():
    ours, dense, lasso = compared(60, 2, 32, 0, lasso=True)
    assert (ours.method, dense.method, lasso.method) == ("ours", "least norm", "LASSO")
    assert ours.found == lasso.found == 1.0
    assert ours.false < 0.05
    assert ours.error < 0.01 < lasso.error < 0.2  # LASSO shrinks what it finds
    assert dense.found < 0.995
    assert dense.error > 0.4
    assert math.isnan(dense.false)


def test_least_norm_is_exact_with_as_many_pairs_as_parameters():
    _, dense = compared(20, 2, 24, 0, lasso=False)
    assert dense.found == 1.0
    assert dense.error < 1e-10


def test_command_prints_and_draws(tmp_path, monkeypatch, capsys):
    drawn = []
    monkeypatch.setattr(recovery, "draw_jacobian", lambda task, path, seed: drawn.append(task.name) or path)
    rows = recovery.recovery(n=(20,), entries=2, pairs=(16, 40), lasso=False, out=tmp_path)
    assert [(row.method, row.pairs) for row in rows] == [(m, k) for k in (16, 40) for m in ("ours", "least norm")]
    assert drawn == ["caustic"]
    printed = capsys.readouterr().out
    assert table(HEADERS, []).splitlines()[0].split() == printed.splitlines()[0].split()
    assert "n = 20: 40 pairs; s ln n = 6" in printed
    assert (tmp_path / "recovery.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SystemExit, match="n must exceed entries"):
        recovery.recovery(n=(4,), entries=4, out=tmp_path)


def test_a_picture_of_a_row_and_a_column(tmp_path, monkeypatch):
    shown = []

    def image(x):
        return torch.nn.functional.avg_pool2d(x.view(-1, 1, 8, 8), 2, 1)[:, 0]

    real = Axes.imshow
    monkeypatch.setattr(Axes, "imshow", lambda self, x, **more: shown.append(x) or real(self, x, **more))
    start = torch.zeros(64, dtype=torch.float64)
    task = replace(small.TASK, n=64, start=lambda run: start, output=Output(image, torch.sum))
    draw_jacobian(task, tmp_path / "jacobian.png", samples=60)
    by_differences, changed, by_samples, found = shown
    assert [one.shape for one in shown] == [(8, 8), (7, 7), (8, 8), (7, 7)]
    assert by_differences[3:5, 3:5].flatten().tolist() == pytest.approx([0.25] * 4)  # pixel (3, 3) averages these
    assert by_differences.sum() == pytest.approx(1.0)
    assert changed[3:5, 3:5].flatten().tolist() == pytest.approx([0.25] * 4)  # parameter (4, 4) is in these
    assert abs(by_samples - by_differences).max() < 0.02
    assert abs(found - changed).max() < 0.02
