"""The study of worker processes, run small: its measurements, and that it notices a fault."""

import json

import pytest
import torch

from experiments.studies import workers as study


@pytest.mark.usefixtures("quick_workers")
def test_kills_and_hangs_change_nothing_and_leave_nothing(tmp_path, capsys) -> None:
    out = tmp_path / "workers.json"
    costs, faults = study.workers(task=None, repeats=1, evaluations=600, kills=2, hangs=1, out=out)
    assert [(one.call, one.points) for one in costs] == [("empty", 1), ("empty", 16), ("48 kB", 1)]
    assert all(one.pool > 0 and one.inline > 0 for one in costs)
    assert (faults.evaluations, faults.kills, faults.hangs) == (600, 2, 1)
    assert faults.right
    assert json.loads(out.read_text())["faults"]["different"] == 0
    assert "times faster" in capsys.readouterr().out


def test_a_wrong_value_is_noticed(monkeypatch) -> None:
    class Wrong:
        lost: dict[int, str] = {}  # noqa: RUF012

        def __init__(self, *_, **__) -> None: ...

        def __enter__(self):
            return self

        def __exit__(self, *_) -> None: ...

        def __call__(self, fn, x):
            return (x**3).sin().sum(1) + (torch.arange(len(x)) == 3) * 1e-15

    monkeypatch.setattr(study, "ProcessPool", Wrong)
    faults = study.disturb(1, 200, 0, 0, 0)
    assert (faults.different, faults.right) == (1, False)
    with pytest.raises(SystemExit):
        study.workers(repeats=0, evaluations=200, kills=0, hangs=0)


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(SystemExit, match="kills must be at least 0, got -1"):
        study.workers(kills=-1)
    for task in ("mugs", "cnn"):  # a name that is not known, and a network
        with pytest.raises(SystemExit, match=f"task must be some of .*, got {task}"):
            study.workers(task=task)
