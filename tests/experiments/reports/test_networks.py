"""What is made of trained networks: figures, ONNX, a table, and the command that makes them."""

import json

import matplotlib.image
import pytest
import torch
from small import BUMP, FAIL_TO_TRAIN, SHIFT

from experiments.ensembles.ensemble import Ensemble
from experiments.problems import catalogue
from experiments.problems.network_task import Size
from experiments.problems.tasks import cnn
from experiments.reports import error_curves, onnx_export, overview_networks, predictions
from experiments.reports.networks import HELD_OUT, conclude, summary
from experiments.reports.overview_networks import network_column
from experiments.reports.trained_network import Result
from experiments.run import run
from experiments.runs.records import Files


@pytest.fixture
def tiny(monkeypatch):
    """CNN in a size for tests."""
    monkeypatch.setitem(cnn.SIZES, "fast", Size(16, 2, 2, evaluations=84, images=12, held_out=4))


def no_files(patched):
    """Leave out what takes time and has no part in the table: figures and the encoder for ONNX."""
    patched.setattr(error_curves, "curves", lambda *_: None)
    patched.setattr(predictions, "draw", lambda *_: None)
    patched.setattr(onnx_export, "export", lambda *_: 0.0)


def ended(folder, methods, runs=2):
    ensemble = Ensemble(folder, range(runs))
    return ensemble.run(ensemble.plan([BUMP], methods))


def test_networks_end_in_logs_figures_encoder_and_table(tmp_path, one_process, capsys, monkeypatch):
    methods = ["our_g", SHIFT]
    outcomes = ended(tmp_path, methods)
    results, folder = conclude(BUMP, outcomes, tmp_path), tmp_path / "bump"
    printed = capsys.readouterr().out
    for method in ("our_g", "shift"):
        for number in range(2):
            lines = (folder / method / f"{number}.jsonl").read_text().splitlines()
            assert {"task", "method", "run", "iteration", "seconds", "evaluations", "sigma"} <= json.loads(
                lines[0]
            ).keys()
    for name in ("errors.png", "predictions.png"):
        assert matplotlib.image.imread(folder / name).std() > 0.01
    assert (folder / "encoder-shift.onnx").exists()
    assert summary(BUMP, results) in printed
    assert [(one.method, one.run) for one in results] == [("our_g", 0), ("shift", 0), ("our_g", 1), ("shift", 1)]
    for one, outcome in zip(results, outcomes, strict=True):
        last = json.loads((folder / one.method / f"{one.run}.jsonl").read_text().splitlines()[-1])
        assert one.parameter_error[1] == pytest.approx(last["parameter_error"])  # of the weights that were kept
        assert one.evaluations == outcome.evaluations
    logs = {path: path.read_bytes() for path in folder.glob("*/*.jsonl")}
    no_files(monkeypatch)
    assert summary(BUMP, conclude(BUMP, ended(tmp_path, methods), tmp_path)) == summary(BUMP, results)
    assert {path: path.read_bytes() for path in folder.glob("*/*.jsonl")} == logs  # nothing is trained twice


def test_a_trained_network_has_a_column_in_the_overview(tmp_path, one_process, monkeypatch):
    assert network_column(tmp_path, "bump") is None
    ended(tmp_path, ["our_g", SHIFT], runs=1)
    (tmp_path / "bump" / HELD_OUT).touch()  # what `conclude` writes
    monkeypatch.setattr(overview_networks.catalogue, "load", lambda *_: BUMP)
    for preferred in ("our_g", "shift"):
        monkeypatch.setattr(overview_networks, "PREFERRED", (preferred,))
        found = network_column(tmp_path, "bump")
        assert (found.task, found.method) == ("bump", preferred)
        assert found.start.shape == found.end.shape == found.target.shape
        assert not torch.equal(found.start, found.target)
        assert not torch.equal(found.start, found.end)
        encoder, _ = BUMP.encoders(0)
        encoder.load_state_dict(torch.load(Files(tmp_path / "bump" / preferred, 0).weights, weights_only=True))
        sought = BUMP.parameters(1, torch.Generator().manual_seed(2**30), held_out=True)
        with torch.no_grad():
            x = encoder(BUMP.image(sought))
        torch.testing.assert_close(255 * found.end, torch.from_numpy(BUMP.pictures(BUMP.image(x), x)[0]).double())
        outcome = json.loads((tmp_path / "bump" / preferred / "0.json").read_text())
        assert found.caption.startswith(f"{outcome['evaluations']} evaluations, error ")


def test_runs_that_fail_are_named_and_left_out(tmp_path, one_process, capsys, monkeypatch):
    no_files(monkeypatch)
    outcomes = ended(tmp_path, [SHIFT, FAIL_TO_TRAIN], runs=1)
    assert [one.method for one in conclude(BUMP, outcomes, tmp_path)] == ["shift"]
    assert "bump fail_to_train 0 failed: ZeroDivisionError: as this method does" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="no run of bump succeeded"):
        conclude(BUMP, [one for one in outcomes if one.status == "failed"], tmp_path)


def test_the_table_has_medians_and_shares():
    network = torch.nn.Identity()
    results = [
        Result("m", number, network, network, seconds, 10 * (number + 1), (1.0, image), (4.0, parameter))
        for number, (seconds, image, parameter) in enumerate([(1.0, 0.5, 0.01), (2.0, 0.05, 1.0), (9.0, 0.1, 0.04)])
    ]
    (row,) = summary(BUMP, results).splitlines()[2:]
    # Roots of the medians 4 and 0.04; quotients 400, 4, 100 and 2, 20, 10.
    assert row.split() == ["m", "20", "2", "2", "0.2", "100", "4", "10", "2", "2", "of", "3"]


@pytest.mark.parametrize("name", ["cnn", "cnn_texture", "cnn_throw"])
def test_onnx_predicts_the_same(name, tmp_path):
    torch.manual_seed(0)
    task = catalogue.load(name)
    images = 4 * torch.rand(5, 2) if name == "cnn_throw" else torch.rand(5, 3, task.size.film, task.size.film)
    difference = onnx_export.export(task.encoder(), images, tmp_path / "encoder.onnx")
    assert 0 <= difference < 1e-4


@pytest.mark.parametrize("names", ["adam", "our_g,adam", ""])
def test_unknown_methods_are_named(names):
    with pytest.raises(SystemExit, match="methods must be some of fr22, fr22_source, our_g, "):
        run(("cnn",), methods=names)
