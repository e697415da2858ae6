"""The commands run, list and report: what they print, refuse and take up again."""

import re
import shlex

import pytest

from experiments.listing import list_, listing
from experiments.methods import METHODS
from experiments.problems.catalogue import FITTING, check_variant, load
from experiments.reports.ensemble_page import page
from experiments.reports.results import load as load_results
from experiments.reports.summary import as_text, summarize
from experiments.run import run
from experiments.runs.records import Outcome
from torch_zerohess.adapters.mitsuba_variants import Probe


def test_list_names_everything():
    text = listing()
    for name in (*FITTING, *METHODS, "cnn"):
        assert re.search(rf"^{name} ", text, re.MULTILINE), name


def test_list_of_a_task_has_the_methods_that_can_be_run_on_it(capsys):
    list_(("brdf",))
    text = capsys.readouterr().out
    rows = re.findall(r"^(\w+) +[+.]", text, re.MULTILINE)
    assert rows == [name for name, method in METHODS.items() if method.unusable(load("brdf")) is None]
    assert re.search(r"^dfo_ls +\+ +image +DFO-LS", text, re.MULTILINE)
    assert "block_gauss_newton not anywhere: made for 100 parameters and more, the task has 7" in text
    assert "texture" not in text
    with pytest.raises(SystemExit, match=r"TASK must be some of .* got bird \(did you mean brdf"):
        list_(("bird",))


def test_list_says_what_is_missing(monkeypatch):
    def load_without(name, *given):
        if name == "quad":
            raise ImportError("task quad needs something", name="something")
        return load(name, *given)

    monkeypatch.setattr("experiments.problems.catalogue.load", load_without)
    assert re.search(r"^quad +task quad needs something$", listing(), re.MULTILINE)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tasks": ("quat",)}, r"TASK must be some of .* got quat \(did you mean quad\?\)"),
        ({"tasks": ()}, "TASK must be some of .* got none"),
        ({"tasks": ("quad",), "methods": "cma"}, r"methods must be some of .* got cma \(did you mean cma_es"),
        ({"tasks": ("quad",), "methods": "CMA"}, r"methods must be some of .* got CMA \(did you mean cma_es"),
        ({"tasks": ("quad",), "runs": 0}, "runs must be at least 1, got 0"),
        ({"tasks": ("quad",), "runs": -1, "seed": 3}, "runs must be at least 1, got -1"),
        ({"tasks": ("quad",), "variant": "foo"}, "variant must be auto, scalar_rgb, llvm_ad_rgb or .*, got foo"),
        ({"tasks": ("quad", "mug"), "variant": "llvm_ad"}, "variant must be auto, scalar_rgb, .*, got llvm_ad"),
        ({"tasks": ("quad",), "jobs": -1}, "jobs must be at least 1, got -1"),
        ({"tasks": ("cnn",), "methods": "cma_es"}, "no method of this command can be run on these tasks"),
        ({"tasks": ("quad", "cnn"), "threads": 0}, "threads must be at least 1, got 0"),
        ({"tasks": ("cnn",), "seed": -1}, "seed must be at least 0, got -1"),
        (
            {"tasks": ("quad", "cnn_texture"), "methods": "dfo_ls"},
            "no method of this command can be run on these tasks",
        ),
    ],
)
def test_wrong_arguments_are_named(arguments, message, tmp_path):
    with pytest.raises(SystemExit, match=message):
        run(arguments.pop("tasks"), out=tmp_path, **arguments)


def test_names_of_variants():
    for name in ("auto", "scalar_rgb", "llvm_ad_mono_polarized", "cuda_ad_spectral_double", "scalar_spectral"):
        check_variant(name, ("quad",))
    for name in ("", "foo", "llvm_ad", "scalar_ad_rgb", "AUTO"):
        with pytest.raises(SystemExit, match=f"variant must be auto, .* of Mitsuba, got {name}$"):
            check_variant(name, ("quad",))


def test_a_variant_is_tried_before_the_first_run_where_a_task_needs_it(tmp_path, one_process, monkeypatch):
    tried = []

    def probe(variant, llvm):
        tried.append(variant)
        return Probe(False, "no driver")

    monkeypatch.setattr("experiments.problems.catalogue.probe", probe)
    for tasks in (("quad", "mug"), ("cnn",)):
        with pytest.raises(SystemExit, match=r"variant must be .* that works here, got cuda_ad_rgb: no driver"):
            run(tasks, methods="our_g", runs=1, variant="cuda_ad_rgb", out=tmp_path)
    assert tried == ["cuda_ad_rgb"] * 2
    assert not list(tmp_path.iterdir())
    run(("quad",), methods="cobyqa", runs=1, variant="cuda_ad_rgb", out=tmp_path)
    assert len(tried) == 2


def test_names_are_taken_in_any_case(tmp_path, one_process, capsys):
    """Documents print MUG for mug."""
    run(("QUAD", "quad"), methods="Cobyqa", runs=1, out=tmp_path)
    assert "1 of 1 runs have ended" in capsys.readouterr().out
    assert (tmp_path / "quad" / "cobyqa" / "0.json").exists()


def test_tasks_that_no_method_goes_with_are_left_out(tmp_path, one_process, capsys):
    run(("cnn", "quad"), methods="cobyqa,dfo_ls", runs=1, out=tmp_path)
    printed = capsys.readouterr().out
    for said in (
        "cobyqa is left out on cnn: trains no networks",
        "dfo_ls is left out on cnn: trains no networks",
        "dfo_ls is left out on quad: the black box returns no residuals",
        "1 of 1 runs have ended",
    ):
        assert said in printed
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["quad"]


def test_networks_and_fits_are_run_by_one_command(tmp_path, capsys, monkeypatch):
    planned = []

    def plan(ensemble, tasks, methods):
        planned.append((ensemble.runs, ensemble.network_runs, ensemble.threads, tasks, methods))
        raise SystemExit("planned")

    monkeypatch.setattr("experiments.ensembles.ensemble.Ensemble.plan", plan)
    for given in ({}, {"runs": 3, "seed": 2, "threads": 4}):
        with pytest.raises(SystemExit, match="planned"):
            run(("quad", "cnn"), methods="our_g", out=tmp_path, **given)
    assert planned == [
        (range(20), range(1), None, ["quad", "cnn"], ["our_g"]),
        (range(2, 5), range(2, 5), 4, ["quad", "cnn"], ["our_g"]),
    ]


def test_a_network_whose_runs_all_failed_does_not_hide_the_others(tmp_path, monkeypatch):
    concluded = []

    def conclude(task, outcomes, folder):
        concluded.append(task.name)
        if task.name == "cnn":
            raise SystemExit("no run of cnn succeeded")

    def ended(ensemble, jobs):
        return [Outcome(name, "our_g", 0, "stopped", "", 1.0, 1.0, 1, 1, []) for name in ("cnn", "cnn_wide")]

    monkeypatch.setattr("experiments.reports.networks.conclude", conclude)
    monkeypatch.setattr("experiments.ensembles.ensemble.Ensemble.plan", lambda *_: [])
    monkeypatch.setattr("experiments.ensembles.ensemble.Ensemble.run", ended)
    with pytest.raises(SystemExit, match="no run of cnn succeeded"):
        run(("cnn", "cnn_wide"), methods="our_g", out=tmp_path)
    assert concluded == ["cnn", "cnn_wide"]


def test_runs_that_could_not_be_run_are_counted_at_the_end(tmp_path, one_process, capsys, monkeypatch):
    """The others have their table; a process that a script waits for does not end with 0."""

    def load_one(name, *given):
        if name == "quad":
            raise RuntimeError("no light")
        return load(name, *given)

    monkeypatch.setattr("experiments.ensembles.processes._load", load_one)
    with pytest.raises(SystemExit, match=r"^2 of 2 runs could not be run; the lines that begin with `not run`"):
        run(("quad",), methods="cobyqa", runs=2, out=tmp_path / "new")
    with pytest.raises(SystemExit, match=r"^2 of 4 runs could not be run"):
        run(("quad", "box2"), methods="cobyqa", runs=2, out=tmp_path, evaluations=5)
    printed = capsys.readouterr().out
    assert "not run: quad cobyqa 1: RuntimeError: no light" in printed
    assert "2 of 4 runs have ended" in printed
    assert as_text(summarize(load_results(tmp_path))) in printed


def test_a_task_whose_runs_all_failed_is_named_at_the_end(tmp_path, one_process, capsys, monkeypatch):
    def fail(self, trial, settings):
        raise ValueError("no")

    monkeypatch.setattr("experiments.methods.method.Method.__call__", fail)
    with pytest.raises(SystemExit, match=r"^no run of quad succeeded$"):
        run(("quad",), methods="cobyqa", runs=2, out=tmp_path)
    assert as_text(summarize(load_results(tmp_path))) in capsys.readouterr().out


def test_a_broken_outcome_is_named_before_anything_is_run(tmp_path, one_process):
    run(("quad",), methods="cobyqa", runs=1, out=tmp_path)
    (tmp_path / "quad" / "cobyqa" / "0.json").write_text("")
    with pytest.raises(SystemExit, match=r"0.json is not the outcome of a run"):
        run(("quad",), methods="cobyqa", runs=2, out=tmp_path)
    assert not (tmp_path / "quad" / "cobyqa" / "1.json").exists()


def test_commands_that_are_printed_can_be_pasted(tmp_path, one_process, capsys):
    out = tmp_path / "two words"
    run(("quad",), methods="cobyqa", runs=1, out=out)
    lines = capsys.readouterr().out.splitlines()
    hints = [shlex.split(line.partition(": ")[2]) for line in lines if "python -m experiments" in line]
    assert hints == [["python", "-m", "experiments", name, str(out)] for name in ("plot", "report")]


def test_run_runs_prints_and_says_how_to_go_on(tmp_path, one_process, no_curves, capsys, monkeypatch):
    run(("quad",), methods="cobyqa, cma_es", runs=2, out=tmp_path, seed=3)
    printed = capsys.readouterr().out
    assert "4 of 4 runs have ended" in printed
    assert as_text(summarize(load_results(tmp_path))) in printed
    for method in ("cobyqa", "cma_es"):
        assert sorted(path.name for path in (tmp_path / "quad" / method).iterdir()) == [
            "3.json",
            "3.jsonl",
            "4.json",
            "4.jsonl",
        ]
    page_of_quad = page(tmp_path)
    assert load("quad").title in page_of_quad

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("experiments.ensembles.ensemble.Ensemble.run", interrupt)
    with pytest.raises(SystemExit, match="the same command goes on"):
        run(("quad",), methods="cobyqa", runs=3, out=tmp_path, seed=3)
