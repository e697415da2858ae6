"""The command line: what it loads, what it says when something is wrong or missing, and how it ends."""

import re
import subprocess
import sys

import pytest

from experiments.commands import main
from experiments.problems import catalogue


@pytest.fixture
def no_mitsuba(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)


@pytest.mark.usefixtures("no_mitsuba")
def test_tasks_that_mitsuba_renders_say_that_it_is_missing() -> None:
    for name in (*catalogue.RENDERED, *catalogue.TRAINING):
        one = catalogue.training if name in catalogue.TRAINING else catalogue.load
        with pytest.raises(ImportError, match=rf"task {name} needs mitsuba, .*pip install 'torch_zerohess") as raised:
            one(name)
        assert raised.value.name == "mitsuba"
    assert catalogue.load("caustic").name == "caustic"
    assert catalogue.load("meshfit").name == "meshfit"


@pytest.mark.usefixtures("no_mitsuba")
@pytest.mark.parametrize(
    "command",
    [
        ["run", "mug"],
        ["run", "quad", "cnn", "--methods", "trust_region,pooled"],
        ["tune", "mug", "--method", "our_g"],
        ["losses", "--tasks", "mug"],
        ["gradients", "mug"],
    ],
    ids=" ".join,
)
def test_commands_say_what_to_install(monkeypatch, tmp_path, command) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["experiments", *command])
    with pytest.raises(SystemExit, match="needs mitsuba, which is not installed: pip install 'torch_zerohess"):
        main()
    assert not list(tmp_path.iterdir())  # nothing was run before


@pytest.mark.usefixtures("no_mitsuba")
def test_list_and_gallery_show_what_is_missing(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["experiments", "list"])
    main()
    printed = capsys.readouterr().out
    for name in (*catalogue.RENDERED, *catalogue.TRAINING):
        assert re.search(rf"^{name} +task {name} needs mitsuba, which is not installed", printed, re.MULTILINE)
    monkeypatch.setattr(sys, "argv", ["experiments", "gallery", str(tmp_path), "--tasks", "mug"])
    with pytest.raises(SystemExit, match="no task of this command can be shown"):
        main()
    assert "task mug needs mitsuba" in "".join(capsys.readouterr())


def test_a_reader_that_has_enough_ends_a_command_without_a_traceback() -> None:
    command = [sys.executable, "-m", "experiments", "list"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        said = running.stderr.read()
    assert running.returncode == 1
    assert "Traceback" not in said
    assert "BrokenPipe" not in said
