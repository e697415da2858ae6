"""The command line: what it loads, what it says when something is wrong or missing, and how it ends."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.commands import COMMANDS, main, usage
from experiments.problems import catalogue

ROOT = Path(__file__).parents[2]
LOADED = """
import sys
sys.argv = ["experiments", *sys.argv[1:]]
from experiments.commands import main
main()
print("\\n".join(sorted(sys.modules)), file=sys.stderr)
"""
SLOW = ("torch", "numpy", "matplotlib", "mitsuba", "pandas", "scipy", "trimesh", "tyro")


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]], ids=str)
def test_the_list_of_commands_loads_none_of_them(arguments) -> None:
    command = [sys.executable, "-c", LOADED, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == usage()
    loaded = set(done.stderr.split())
    assert "experiments.commands" in loaded
    assert not loaded & set(SLOW)


def test_the_list_has_a_line_for_every_command() -> None:
    for name, command in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(command.help)}$", usage(), re.MULTILINE)
    assert max(map(len, usage().splitlines())) <= 80


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_can_be_called_and_has_help(name, capsys) -> None:
    assert COMMANDS[name].load().__doc__
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"usage: python -m experiments {name} ")
    # Every argument is explained.
    for argument in inspect.signature(COMMANDS[name].load()).parameters.values():
        shown = f"--{argument.name.replace('_', '-')}"
        assert argument.kind is argument.POSITIONAL_ONLY or shown in printed


def test_where_nothing_can_be_written_nothing_is_measured(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    taken = tmp_path / "file"
    taken.touch()
    out = str(taken / "below")
    needed = {"run": ["quad"], "report": ["results"], "bench_device": ["--device", "cpu"]}
    with_out = [name for name, one in COMMANDS.items() if "out" in inspect.signature(one.load()).parameters]
    assert len(with_out) >= 16
    refused = f"out must be a (folder|file) that can be written, got {re.escape(out)}: Not a directory"
    for name in with_out:
        with pytest.raises(SystemExit, match=refused):
            main([name, *needed.get(name, []), "--out", out])
        said = capsys.readouterr()
        assert said.out == ""
        assert "%" not in said.err  # of a progress bar
    assert list(tmp_path.iterdir()) == [taken]


def test_a_long_command_says_at_once_that_it_has_begun(monkeypatch, capsys) -> None:
    said = []

    def load(self) -> object:
        said.append(capsys.readouterr().err)
        return lambda: None

    monkeypatch.setattr("experiments.commands.Command.load", load)
    main(["run"])
    main(["list"])
    assert said == ["run: loading\n", ""]


def test_an_unknown_command_is_named_with_those_that_are_near() -> None:
    with pytest.raises(SystemExit, match=r"COMMAND must be one of list, run, .* got rn \(did you mean run\?\)"):
        main(["rn"])


def test_a_missing_package_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for loaded in ("matplotlib.figure", "experiments.reports.error_curves"):
        monkeypatch.delitem(sys.modules, loaded, raising=False)
    with pytest.raises(SystemExit, match=r"plot needs matplotlib, .*: pip install '\.\["):
        main(["plot", "results"])


@pytest.fixture
def no_mitsuba(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)


@pytest.mark.usefixtures("no_mitsuba")
def test_tasks_that_mitsuba_renders_say_that_it_is_missing() -> None:
    for name in (*catalogue.RENDERED, *catalogue.RENDERED_NETWORKS):
        with pytest.raises(ImportError, match=rf"task {name} needs mitsuba, .*pip install '.") as raised:
            catalogue.load(name)
        assert raised.value.name == "mitsuba"
    assert catalogue.load("caustic").name == "caustic"
    assert catalogue.load("meshfit").name == "meshfit"
    assert catalogue.load("cnn_throw").name == "cnn_throw"


def test_tasks_that_mujoco_simulates_say_that_it_is_missing(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for name in catalogue.SIMULATED:
        with pytest.raises(ImportError, match=rf"task {name} needs mujoco, .*pip install '."):
            catalogue.load(name)


@pytest.mark.usefixtures("no_mitsuba")
@pytest.mark.parametrize(
    "command",
    [
        ["run", "mug"],
        ["run", "quad", "cnn", "--methods", "descent,memory_newton"],
        ["tune", "mug", "--method", "our_g"],
        ["losses", "--tasks", "mug"],
        ["gradients", "mug"],
        ["robustness", "mug"],
    ],
    ids=" ".join,
)
def test_commands_say_what_to_install(monkeypatch, tmp_path, command) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["experiments", *command])
    with pytest.raises(SystemExit, match=r"needs mitsuba, which is not installed: pip install '\.\["):
        main()
    assert not list(tmp_path.iterdir())  # nothing was run before


@pytest.mark.usefixtures("no_mitsuba")
def test_list_and_gallery_show_what_is_missing(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["experiments", "list"])
    main()
    printed = capsys.readouterr().out
    for name in (*catalogue.RENDERED, *catalogue.RENDERED_NETWORKS):
        assert re.search(rf"^{name} +task {name} needs mitsuba, which is not installed", printed, re.MULTILINE)
    monkeypatch.setattr(sys, "argv", ["experiments", "gallery", str(tmp_path), "--tasks", "mug"])
    with pytest.raises(SystemExit, match="no task of this command can be shown"):
        main()
    assert "task mug needs mitsuba" in "".join(capsys.readouterr())


def test_a_reader_that_has_enough_ends_a_command_without_a_traceback() -> None:
    command = [sys.executable, "-m", "experiments", "list", "quad"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        said = running.stderr.read()
    assert running.returncode == 1
    assert "Traceback" not in said
    assert "BrokenPipe" not in said


@pytest.mark.parametrize(
    "command",
    [["run", "quad"], ["robustness", "box2"], ["gallery", "results"], ["figures", "7"], ["gradients"]],
    ids=" ".join,
)
def test_a_variant_that_mitsuba_does_not_have_is_named(monkeypatch, tmp_path, command) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=r"variant must be auto, .* or another of Mitsuba, got foo"):
        main([*command, "--variant", "foo"])
    assert not list(tmp_path.iterdir())
