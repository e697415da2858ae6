"""The commands of the documents are run as they stand there, but at a small size."""

import shlex

import pytest
from document_texts import TEXTS, experiment_calls

from experiments.commands import COMMANDS, call
from experiments.ensembles import ensemble
from experiments.problems import catalogue
from experiments.problems.network_task import NetworkTask, Size

AFFINE = 1024 + 76
"""Renders before the first step of training on CNN-TEXTURE; with fewer, training has 4 000 steps without a render."""
TINY = Size(32, 2, 2, evaluations=24, images=16, held_out=3)
LINES = sorted({line for text in TEXTS.values() for line in experiment_calls(text)})


@pytest.fixture
def tiny_networks(monkeypatch):
    """Network tasks have small images, and few."""
    load = catalogue.load

    def load_tiny(*given):
        task = load(*given)
        return type(task)(TINY, "scalar_rgb", 1) if isinstance(task, NetworkTask) else task

    monkeypatch.setattr(catalogue, "load", load_tiny)


@pytest.fixture
def few_steps(monkeypatch):
    """Methods with a memory take no more steps than there are evaluations."""
    settings = ensemble.settings_of

    def fewer(method, task):
        steps = {"least_steps": 24} if method in ("memory_newton", "memory_targets") else {}
        return settings(method, task) | steps

    monkeypatch.setattr(ensemble, "settings_of", fewer)


def small(line):
    """Return the command of a line and its arguments, of which later ones win, without storing a table."""
    command, *arguments = shlex.split(line.partition("#")[0])
    evaluations = AFFINE + 24 if "cnn_texture" in arguments else 24
    return command, [*arguments, "--runs", "1", "--evaluations", str(evaluations), "--jobs", "1"]


@pytest.mark.parametrize("line", LINES)
def test_it_ends_with_a_table(line, tmp_path, capsys, one_process, tiny_networks, few_steps):
    command, arguments = small(line)
    call(command, COMMANDS[command].load(), [*arguments, "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "failed" not in printed
    methods = arguments[arguments.index("--methods") + 1].split(",") if "--methods" in arguments else []
    for method in methods or ["our_g" if command == "run" else "ours"]:
        assert f"\n{method} " in printed or f" {method} " in printed


def test_the_documents_have_commands():
    assert len(LINES) >= 2
