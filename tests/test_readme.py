"""The documents: their code runs, their commands can be called, their tables are those stored, their links lead on."""

import functools
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch
from document_texts import ROOT, TEXTS, blocks, experiment_calls, prose

from experiments.commands import COMMANDS, call
from experiments.methods import METHODS
from experiments.problems.catalogue import TASKS, chosen
from experiments.reports.documents import differences

SETUP = "python3 -m venv .venv && .venv/bin/pip install"
FILE = re.compile(r"[\w./-]+\.(?:py|h|cpp|csv|png|webp|toml|md)(?!\w)")


def params(found: dict[str, list[str]]) -> list[Any]:
    return [pytest.param(name, one, id=f"{name}-{k}") for name, many in found.items() for k, one in enumerate(many)]


@pytest.mark.parametrize("name", TEXTS)
def test_nothing_is_left_to_fill_in(name):
    assert "@@" not in TEXTS[name]


@pytest.mark.parametrize("name", TEXTS)
def test_code_runs(name, tmp_path, monkeypatch):
    """Every block of Python, one after the other, as a reader would."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(TEXTS[name], "python"):
        exec(compile(block, name, "exec"), names)
    if name == "README.md":
        assert names["fit"].value == 0.0
    if name == "torch_zerohess/README.md":
        assert names["search"].value < 0.05
        assert names["found"].value <= 1e-6
        # 60 seeds take 9 to 36. This one takes 40 or 41: threads of the renderer round differently from call to call.
        assert names["found"].evaluations <= 60
        assert names["state"]["progress"]["evaluations"] == names["search"].evaluations >= 20
        assert names["calibrated"].value < 0.5 * names["missed"]([0.3, 0.8])
        assert names["wrong"] < 0.5  # a guess has log 2
        assert names["writer"][0].weight.grad.abs().sum() > 0
        spot, images = names["spot"], names["images"]
        assert (spot(names["encoder"](images)) - images).square().mean() < 0.5 * names["before"]
        assert (names["allowed"].x - 1).abs().max() < 1e-4
        assert (names["fitted"].x - torch.tensor([0.6, 0.3])).abs().max() < 0.01


@pytest.mark.parametrize("name", TEXTS)
def test_every_row_of_a_table_has_the_cells_of_its_header(name):
    cells = 0
    for line in TEXTS[name].splitlines():
        count = len(re.findall(r"(?<!\\)\|", line)) if line.startswith("|") else 0
        assert not (cells and count) or count == cells, line
        cells = count


def searches(path: Path) -> list[str]:
    """The commands in comments of a file of settings, with lines that end in a backslash joined, cut at `;`."""
    text = re.sub(r"\\\n *# *", "", path.read_text())
    return [line.partition(";")[0] for line in re.findall(r"# (tune .*)", text)]


CALLS = {name: experiment_calls(text) for name, text in TEXTS.items()}
CALLS |= {one.name: searches(one) for one in sorted((ROOT / "experiments/methods/settings").glob("*.py"))}


@pytest.mark.parametrize(("name", "line"), params(CALLS))
def test_commands_can_be_called(name, line):
    """They are parsed by the command's own parser; `test_documented_runs.py` runs them at a small size."""
    command, *arguments = shlex.split(line.partition("#")[0])
    assert command in COMMANDS
    function, given = COMMANDS[command].load(), {}

    @functools.wraps(function)
    def instead(*positional, **keywords):
        given.update(keywords)
        given["tasks"] = positional[0] if positional else keywords.get("tasks", ())

    call(command, instead, arguments)
    if given.get("methods") not in (None, "all"):
        chosen("methods", given["methods"].split(","), list(METHODS))
    if command == "tune":
        chosen("method", [given["method"]], list(METHODS))
        chosen("task", [given["tasks"] or given["task"]], list(TASKS))
    if given["tasks"] and isinstance(given["tasks"], tuple):
        chosen("tasks", given["tasks"], list(TASKS))


def test_a_wrong_command_would_be_noticed():
    for wrong in ("run quad --metods cobyqa", "run quad --runs many"):
        with pytest.raises(SystemExit):
            test_commands_can_be_called("here", wrong)
    with pytest.raises(SystemExit, match="methods must be some of"):
        test_commands_can_be_called("here", "run quad --methods cobyca")
    with pytest.raises(AssertionError):
        test_commands_can_be_called("here", "rum quad")


@pytest.mark.parametrize("name", TEXTS)
def test_commands_named_in_prose_exist(name):
    named = re.findall(r"python -m experiments (\w+)", TEXTS[name])
    assert set(named) <= set(COMMANDS)


def test_every_command_has_a_row_in_a_table():
    rows = {one for text in TEXTS.values() for one in re.findall(r"^\| `(\w+)", text, re.MULTILINE)}
    assert set(COMMANDS) <= rows


def test_setup_commands_are_one_line_each():
    """An empty clone needs one line for the main job and one for the tests."""
    setups = [block.strip() for block in blocks(TEXTS["README.md"], "bash") if block.startswith("python3 -m venv")]
    assert len(setups) == 2
    for setup in setups:
        assert setup.startswith(SETUP)
        assert "\n" not in setup
    main, tests = setups
    assert main.endswith("python -m experiments run cnn --methods our_g,memory_newton --evaluations 100")
    assert tests.endswith("python -m pytest -q -n 2 --dist loadfile")


@pytest.mark.parametrize("name", TEXTS)
def test_tables_are_those_that_are_stored(name):
    assert differences(TEXTS[name]) == [], "run `python -m experiments readme`"


LINKS = {name: re.findall(r"\]\((?![a-z]+:)([^)\s]+)\)", prose(text)) for name, text in TEXTS.items()}
"""To files and headings of the repository."""


@pytest.mark.parametrize(("name", "link"), params(LINKS))
def test_links_lead_somewhere(name, link):
    path, _, heading = link.partition("#")
    target = (ROOT / name).parent / path if path else ROOT / name
    assert target.exists(), f"{name} links to {link}"
    if heading:
        titles = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)
        assert heading in {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


MADE = {"errors.png", "predictions.png", "report.html", "index.html"}
"""What a command writes into a folder of results."""


def files(text: str) -> list[str]:
    """Names of files in the prose, but of those that a command writes or a reader chooses."""
    named = FILE.findall(" ".join(re.findall(r"`([^`\n]+)`", prose(text))))
    return sorted({one for one in named if one not in MADE and "NAME" not in one})


NAMED = {name: files(text) for name, text in TEXTS.items()}


@pytest.mark.parametrize(("name", "file"), params(NAMED))
def test_named_files_exist(name, file):
    """A path is from the root or from the document; a bare name is the name of a file anywhere in the tree."""
    found = [(ROOT / file).exists(), ((ROOT / name).parent / file).exists()]
    if "/" not in file:
        found += [any((ROOT / top).rglob(file)) for top in ("torch_zerohess", "experiments", "tests", "csrc")]
    assert any(found), f"{name} names {file}"


def test_constants_that_are_named_exist():
    """The prose before the list of constants names those without a row."""
    named = set(re.findall(r"`(_?[A-Z][A-Z_]+)`", TEXTS["tests/README.md"]))
    sources = "\n".join(path.read_text() for path in (ROOT / "torch_zerohess").rglob("*.py"))
    assigned = {name for line in re.findall(r"^([A-Z_, ]+) = ", sources, re.MULTILINE) for name in line.split(", ")}
    assert len(named) > 5
    assert named <= assigned
