"""Positional arguments that several commands have, as their help shows them."""

from pathlib import Path
from typing import Annotated

import tyro

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
Tasks = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="TASK...")]
OptionalTasks = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[TASK...]")]
