"""The study of training steps with a memory, run small: what is counted, and that fits are in the means."""

from experiments.studies import memory_steps as study
from torch_zerohess.surrogates.memory import Memory


def test_parts_of_training_and_their_evaluations(monkeypatch):
    kept = {}
    monkeypatch.setattr(study.result_files, "may_keep", lambda name: None)
    monkeypatch.setattr(study.result_files, "show", lambda headers, rows, name: kept.update({name: rows}))
    rows = study.memory_steps((3, 8), store="steps")
    assert [row.evaluations for row in rows] == [48, 48, 6, 6, 48, 48]
    assert [row.steps for row in rows] == ["1 to 3", "4 to 8"] * 3
    assert len(kept["steps"]) == 6
    assert all(0.0 <= row.median <= row.longest for row in rows)


def test_fits_and_thinning_are_part_of_the_steps():
    memory = Memory(capacity=100)
    study.measured("memory", memory, (8,), 0)
    assert memory.ready
    assert memory.evaluations == 8 * 48
    assert len(memory) <= 100
