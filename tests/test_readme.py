"""The README's code runs, and its commands are those that exist."""

import re
import subprocess
import sys
from pathlib import Path

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_nothing_is_left_to_fill_in():
    assert "@@" not in README


def test_python_blocks_run():
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert blocks
    names: dict = {}
    for block in blocks:  # one after the other, as a reader would
        exec(compile(block, "README.md", "exec"), names)
    assert names["fit"].value == 0.0
    assert names["search"].value < 0.05
    assert names["found"].value <= 1e-6
    assert names["found"].evaluations < 100


def test_setup_commands_are_one_line_each():
    first, second = (block.strip() for block in re.findall(r"```bash\n(.*?)```", README, re.DOTALL))
    for command in (first, second):
        assert command.startswith("python3 -m venv .venv && .venv/bin/pip install")
        assert "\n" not in command
    assert first.endswith("python -m experiments run cnn --methods our_g,pooled")
    assert second.endswith("python -m pytest -q")


def test_every_command_has_help():
    names = re.findall(r"^\| `(\w+)", README, re.MULTILINE)
    expected = [
        *("list", "run", "table", "plot", "report", "tune", "nonpsd", "losses", "gradients", "robustness", "gallery"),
        *("caustic", "error", "bench", "stability", "doctor"),
    ]
    commands = [name for name in names if name in expected]
    assert commands == expected
    shown = subprocess.run(
        [sys.executable, "-m", "experiments", "--help"],
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert all(name in shown for name in commands)
