"""The comparison with a device, run small on the processor."""

import json

import pytest

from experiments.studies.bench_device import bench_device


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"device": "mps"}, "device must be cuda or cpu, got mps"),
        ({"device": "cpu", "repeats": 0}, "repeats must be at least 1, got 0"),
        ({"device": "cpu", "wide": 0}, "wide must be at least 1, got 0"),
    ],
)
def test_wrong_arguments_are_named(wrong, message) -> None:
    with pytest.raises(SystemExit, match=message):
        bench_device(**wrong)


def test_a_missing_device_is_named(monkeypatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(SystemExit, match="device is cuda, but torch finds none"):
        bench_device()


def test_every_row_is_measured_and_kept(monkeypatch, tmp_path) -> None:
    kept = {}
    monkeypatch.setattr("experiments.studies.bench_device.may_keep", lambda name: None)
    monkeypatch.setattr("experiments.studies.bench_device.keep", lambda headers, rows, name: kept.update({name: rows}))
    out = tmp_path / "device.json"
    rows = bench_device(device="cpu", repeats=2, n=500, samples=4, wide=20, out=out, store="device")
    noise = [
        f"{what}, {dtype}, {name}"
        for dtype in ("float32", "float64")
        for name in ("gaussian", "aggregate")
        for what in ("noise", "points")
    ]
    assert [row.operation for row in rows] == [
        *noise,
        "Hessian",
        "gradient + HVP, drawn again",
        "layer: forward + backward",
    ]
    assert all(row.ratio == row.compared / row.seconds > 0 for row in rows)
    assert [row["ratio"] for row in json.loads(out.read_text())] == [row.ratio for row in rows]
    assert [row[-1] for row in kept["device"]] == [row.ratio for row in rows]
