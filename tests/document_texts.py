"""The documents of the project, and the code and the commands in them."""

import re
from pathlib import Path

from experiments.reports.documents import DOCUMENTS

ROOT = Path(__file__).parents[1]
TEXTS = {name: (ROOT / name).read_text() for name in DOCUMENTS if (ROOT / name).exists()}
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
COMMAND = re.compile(r"^(?:\S*/)?python3? -m experiments (.*)$")


def blocks(text: str, language: str) -> list[str]:
    """Return the blocks of code in a language."""
    return [content for kind, content in BLOCK.findall(text) if kind == language]


def prose(text: str) -> str:
    """Return a document without its blocks of code."""
    return BLOCK.sub("", text)


def commands(text: str) -> list[str]:
    """Return command lines in blocks of shell, with lines that end in a backslash joined, cut at `&&`."""
    lines = [line for block in blocks(text, "bash") for line in block.replace("\\\n", " ").splitlines()]
    return [part.strip() for line in lines for part in line.split("&&") if part.strip()]


def experiment_calls(text: str) -> list[str]:
    """Return what comes after `python -m experiments` in the command lines."""
    return [match[1] for line in commands(text) if (match := COMMAND.match(line))]
