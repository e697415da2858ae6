"""The direction of imports, what the package loads, and the size of its modules, read from the source itself."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import torch_zerohess

PACKAGE = Path(__file__).parents[1] / "torch_zerohess"
# DESIGN section 4, left to right. A module may import only from those before it; a folder counts as one.
LAYERS = [
    *("smoothing", "philox", "quantiles", "proposals", "extension", "kernels", "linear_map", "stein", "samplers"),
    *("perturbations", "evaluators", "evaluation", "standard_error", "estimate", "finite_differences", "opaque"),
    *("blackbox", "curvature", "schedules", "losses", "optim", "minimize", "adapters", "doctor"),
]
MOST_LINES = 320
MODULES = sorted(PACKAGE.rglob("*.py"))


def name(path: Path) -> str:
    """Dotted name within the package: optim.newton, or the empty string for its __init__."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(path: Path) -> set[str]:
    """Modules of the package that a file imports, anywhere in it."""
    known = {name(module) for module in MODULES}
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}:{node.lineno}: import by the full name, not a relative one"
            module = node.module or ""
            names = [f"{module}.{alias.name}" for alias in node.names]
        for full in names:
            if full.split(".")[0] == "torch_zerohess":
                tail = full.split(".")[1:]
                while ".".join(tail) not in known:  # a name inside a module
                    tail = tail[:-1]
                found.add(".".join(tail))
    return found


def test_every_module_has_a_layer() -> None:
    layers = {name(path).split(".")[0] for path in MODULES} - {""}
    assert layers - set(LAYERS) == set(), "add it to LAYERS, where it belongs"


@pytest.mark.parametrize("path", [path for path in MODULES if name(path)], ids=name)
def test_imports_go_one_way(path: Path) -> None:
    own = name(path)
    layer = own.split(".")[0]
    for other in imported(path):
        assert other != "", f"{own} imports from the top of the package: import from the module itself"
        above = other.split(".")[0]
        allowed = above == layer or LAYERS.index(above) < LAYERS.index(layer)  # within a folder: see the next test
        assert allowed, f"{own} imports {other}, which is to its right"


def test_modules_of_one_folder_have_no_cycle() -> None:
    graph = {name(path): imported(path) for path in MODULES if name(path)}
    done: set[str] = set()
    while len(done) < len(graph):
        ready = {module for module in graph if module not in done and graph[module] - {module} <= done}
        assert ready, f"import cycle among {sorted(set(graph) - done)}"
        done |= ready


@pytest.mark.parametrize("path", MODULES, ids=lambda path: name(path) or "__init__")
def test_modules_are_small_and_say_what_they_are(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) <= MOST_LINES
    assert ast.get_docstring(ast.parse(text)), "a module begins with what it is about"


LOADED = """
import sys
import torch
before = set(sys.modules)
import torch_zerohess
print("\\n".join(sorted(set(sys.modules) - before)))
"""


def test_import_loads_nothing_but_torch_and_the_standard_library() -> None:
    command = [sys.executable, "-W", "error", "-c", LOADED]
    done = subprocess.run(
        command, cwd=Path(torch_zerohess.__file__).parents[1], capture_output=True, text=True, check=True
    )
    loaded = {module.split(".")[0] for module in done.stdout.split()}
    assert "torch_zerohess" in loaded
    assert loaded - {"torch_zerohess", "torch"} - set(sys.stdlib_module_names) == set()
    # Nor the parts of torch that a plain `import torch` leaves alone because they are slow: import never compiles.
    assert not [module for module in done.stdout.split() if module.startswith(("torch.utils.cpp", "torch._inductor"))]
