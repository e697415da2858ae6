"""The training tasks at a size for tests: the real scenes, networks, methods, logs and figures."""

import itertools
import json
import math
from dataclasses import replace

import matplotlib.image
import pytest
import torch

from experiments.ensembles.run_training import summary, train_all
from experiments.methods.pooled import Pooled
from experiments.methods.training import METHODS, encoders, train
from experiments.problems.tasks.cnn import ANGLES, PRESETS, CnnPreset, CnnTask
from experiments.reports.onnx_export import export
from experiments.run import run
from experiments.runs.recorder import Recorder
from experiments.runs.records import Files, Log, Record, read

SAMPLED = [name for name in METHODS if name != "pooled"]
TINY = CnnPreset(16, 2, 2, (2, 2, 2), evaluations=84, images=12, held_out=4)


class Quick(CnnTask):
    pooled = Pooled(temperature=0.1, steps=20, batch=4, draws=4, rank=8, first=8, rows=10)


@pytest.fixture(scope="module")
def scene():
    return TINY.scene(variant="scalar_rgb", threads=1)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_encoder_has_the_size_of_the_source(preset):
    encoder = PRESETS[preset].encoder()
    assert sum(p.numel() for p in encoder.parameters()) == 267_745
    size = PRESETS[preset].film
    assert encoder(torch.zeros(2, 3, size, size)).shape == (2, 1)


def test_loss_is_zero_at_the_truth_and_counted(scene):
    task = CnnTask(TINY, 0, scene)
    images, rotation = task.training
    assert float(rotation.min()) >= ANGLES[0]
    assert float(rotation.max()) <= ANGLES[1]
    assert float(task.loss(rotation, images).max()) < 1e-12
    wrong = task.loss(rotation + 2.0, images)
    assert float(wrong.min()) > 1e-5
    assert task.evaluations == 2 * TINY.images


def test_held_out_images_are_the_same_for_all_seeds_and_new(scene):
    first, second = CnnTask(TINY, 0, scene), CnnTask(TINY, 1, scene)
    assert torch.equal(first.held_out[1], second.held_out[1])
    assert not torch.equal(first.training[1], second.training[1])
    assert not set(first.training[1].flatten().tolist()) & set(first.held_out[1].flatten().tolist())


@pytest.mark.parametrize("name", METHODS)
def test_every_method_trains_within_its_budget(scene, name):
    task, recorder = Quick(TINY, 0, scene), Recorder("cnn", name, 0)
    encoder = train(task, METHODS[name], 0, recorder)
    method, records, start = METHODS[name], recorder.rows, encoders(task, 0)[1]
    if name in SAMPLED:
        per_step = method.batch * method.evaluations(1)
        assert [r.evaluations for r in records] == list(range(0, TINY.evaluations + 1, per_step))
    else:
        assert records[1].evaluations == Quick.pooled.first
        assert len(records) == 1 + 10 + 1  # every second step, and the last one
    assert [r.iteration for r in records] == list(range(len(records)))
    assert records[-1].evaluations == recorder.evaluations == task.evaluations <= TINY.evaluations
    assert TINY.evaluations - task.evaluations < 28
    assert (records[0].image_error, records[0].parameter_error) == (
        task.image_error(start),
        task.parameter_error(start),
    )
    assert recorder.seconds - records[-1].seconds < 0.01  # nothing after the training is timed
    assert all(a.seconds < b.seconds for a, b in itertools.pairwise(records))
    assert not any(torch.equal(a, b) for a, b in zip(encoder.parameters(), start.parameters(), strict=True))
    assert all(math.isfinite(r.parameter_error) for r in records)
    images = [r.image_error for r in records if r.image_error is not None]
    assert all(map(math.isfinite, images))
    assert len(images) == (len(records) if name in SAMPLED else 3)


@pytest.mark.parametrize("name", METHODS)
def test_a_run_repeats_itself(scene, name):
    task, runs = Quick(TINY, 0, scene), []
    for _ in range(2):
        recorder = Recorder("cnn", name, 3)
        train(task, METHODS[name], 3, recorder)
        runs.append([(r.evaluations, r.loss, r.parameter_error) for r in recorder.rows])
    assert runs[0] == runs[1]


@pytest.mark.parametrize("name", ["our_g", "our_hvpa", "pooled"])
def test_methods_learn(name):
    """On a stand-in for the renderer, a smooth bowl in the angle, each divides the parameter error by ten."""

    class Bowl(CnnTask):
        pooled = Pooled(temperature=0.1, steps=300, rank=64)

        def render(self, rotation):
            x = torch.linspace(0, 1, 16)
            position = (rotation.reshape(-1, 1, 1, 1) - 4.5) / 18
            image = torch.exp(-0.5 * ((x - position) / 0.15) ** 2)
            return image.expand(-1, 3, 16, 16).contiguous()

    task = Bowl(CnnPreset(16, 1, 2, (2, 2, 2), evaluations=1500, images=256, held_out=32), 0, None)
    recorder = Recorder("cnn", name, 0)
    encoder, start = train(task, METHODS[name], 0, recorder), recorder.rows[0]
    assert task.parameter_error(encoder) < 0.1 * start.parameter_error
    assert task.image_error(encoder) < 0.2 * start.image_error


def test_command_writes_logs_figures_encoder_and_table(tmp_path, capsys):
    names = ("our_g", "our_hvpa", "pooled")

    def command():
        return train_all(Quick, TINY, [METHODS[name] for name in names], range(2), tmp_path, "scalar_rgb", 1)

    results, folder = command(), tmp_path / "cnn"
    printed = capsys.readouterr().out
    for method in names:
        for seed in range(2):
            rows = [json.loads(line) for line in (folder / method / f"{seed}.jsonl").read_text().splitlines()]
            assert {"task", "method", "run", "iteration", "seconds", "evaluations", "sigma"} <= rows[0].keys()
            assert rows[0]["image_error"] > 0
        assert method in printed
    for name in ("errors.png", "predictions.png"):
        assert matplotlib.image.imread(folder / name).std() > 0.01
    assert (folder / "encoder-pooled.onnx").exists()
    assert summary(Quick, results) in printed
    logs = {path: path.read_bytes() for path in folder.glob("*/*.jsonl")}
    assert summary(Quick, command()) == summary(Quick, results)  # nothing is trained twice
    assert {path: path.read_bytes() for path in folder.glob("*/*.jsonl")} == logs


@pytest.mark.parametrize("name", ["our_g", "our_hvpa", "pooled"])
@pytest.mark.parametrize("calls", [0, 1, 3])
def test_an_interrupted_training_goes_on_with_the_same_rows(scene, tmp_path, name, calls):
    class Interrupted(Quick):
        def image(self, rotation):
            if self.calls == calls:
                raise KeyboardInterrupt
            self.calls += 1
            return super().image(rotation)

        calls = 0

    whole = Recorder("cnn", name, 0)
    train(Quick(TINY, 0, scene), METHODS[name], 0, whole)
    files = Files(tmp_path, 0)
    recorder, interrupted = Recorder("cnn", name, 0, files), Interrupted(TINY, 0, scene)
    with pytest.raises(KeyboardInterrupt):
        train(interrupted, METHODS[name], 0, recorder)
    recorder.close(ended=False)
    before = list(read(files.log))
    recorder, task = Recorder("cnn", name, 0, files), Quick(TINY, 0, scene)
    train(task, METHODS[name], 0, recorder)
    recorder.close(ended=True)
    after = list(read(files.log))
    assert after[: len(before)] == before
    assert [replace(row, seconds=0.0) for row in after] == [replace(row, seconds=0.0) for row in whole.rows]
    assert task.evaluations == whole.evaluations - interrupted.evaluations > 0


def test_onnx_predicts_the_same(tmp_path):
    torch.manual_seed(0)
    encoder = PRESETS["fast"].encoder()
    difference = export(encoder, torch.rand(5, 3, 64, 64), tmp_path / "encoder.onnx")
    assert 0 <= difference < 1e-4


def test_log_survives_a_cut_line(tmp_path):
    path = tmp_path / "log.jsonl"
    log = Log(path)
    record = Record("cnn", "our_g", 0, 0, 0.1, 5, 1.0, 2.0, 2.0, 3.0)
    log(record)
    log.close()
    path.write_text(path.read_text() + '{"task": "cn')
    assert list(read(path)) == [record]


@pytest.mark.parametrize("names", ["adam", "our_g,adam", ""])
def test_unknown_methods_are_named(names):
    with pytest.raises(SystemExit, match="fr22, our_g, our_h, our_hvp, our_hvpa, pooled"):
        run(("cnn",), methods=names)
