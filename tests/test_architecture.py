"""The direction of imports in both trees, what importing loads, and the size of modules, read from the source."""

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# A folder, or a module in a list, imports only from those before it. Imports inside functions count too.
LAYERS = {
    "torch_zerohess": [
        *(
            "version",
            "wrappers",
            "arguments",
            "precision",
            "threads",
            "evaluation_mode",
            "choice",
            "smoothing",
            "losses",
            "heads",
            "sampling",
            "surrogates",
            "evaluators",
            "estimation",
            "linalg",
            "autograd",
        ),
        *(f"search.{one}" for one in ("protocol", "region", "gauss_newton", "descent", "sparse", "gaussian_process")),
        *("search.descent_and_gaussian_process", "search.sparse_or_dense", "search.trust_region"),
        *("optim", "minimization", "minimize", "adapters", "doctor", "__main__"),
    ],
    "experiments": [
        *("arguments", "problems", "runs", "methods", "ensembles", "reports", "studies"),
        *("listing", "run", "commands", "__main__"),
    ],
}
DOORS = {tree: {"", *(one.rpartition(".")[0] for one in listed)} for tree, listed in LAYERS.items()}
MOST_LINES = 300
MAKERS = {
    f"torch.{one}"
    for one in (
        *("arange", "as_tensor", "empty", "eye", "full", "linspace", "logspace", "ones", "rand", "randint", "randn"),
        *("randperm", "scalar_tensor", "tensor", "tril_indices", "triu_indices", "zeros"),
    )
}
DEFAULT_DEVICE = {"search.protocol.space": ["torch.as_tensor(own_copy(x0), dtype=None if kept else torch.float64)"]}
MODULES = {tree: sorted((ROOT / tree).rglob("*.py")) for tree in LAYERS}
CASES = [pytest.param(tree, path, id=str(path.relative_to(ROOT))) for tree in LAYERS for path in MODULES[tree]]


def name(tree: str, path: Path) -> str:
    """Dotted name within the tree: optim.newton, or the empty string for its __init__."""
    parts = path.relative_to(ROOT / tree).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def layer(tree: str, module: str) -> str:
    """The folder or module in the list to which a module belongs; its own name if there is none."""
    return next((one for one in LAYERS[tree] if f"{module}.".startswith(f"{one}.")), module)


@functools.cache
def names_of(tree: str) -> set[str]:
    return {name(tree, module) for module in MODULES[tree]}


@functools.cache
def imported(tree: str, path: Path) -> set[str]:
    """Modules of the tree that a file imports, anywhere in it."""
    known, found = names_of(tree), set()
    for node in ast.walk(ast.parse(path.read_text())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}:{node.lineno}: import by the full name, not a relative one"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for full in names:
            if full.split(".")[0] == tree:
                tail = full.split(".")[1:]
                while ".".join(tail) not in known:  # a name inside a module
                    tail = tail[:-1]
                found.add(".".join(tail))
    return found


@pytest.mark.parametrize(("tree", "path"), [one for one in CASES if one.values[0] == "torch_zerohess"])
def test_every_tensor_is_made_on_a_device_that_is_named(tree: str, path: Path) -> None:
    """The default device of torch may be another one. Only a start that is a list goes to it."""
    unnamed = []
    for node in ast.walk(ast.parse(path.read_text())):
        makes = isinstance(node, ast.Call) and ast.unparse(node.func) in MAKERS
        if makes and "device" not in {one.arg for one in node.keywords}:
            unnamed.append(ast.unparse(node))
    assert unnamed == DEFAULT_DEVICE.get(name(tree, path), [])


@pytest.mark.parametrize(("tree", "path"), [one for one in CASES if one.values[0] == "torch_zerohess"])
def test_random_numbers_are_of_a_type_that_is_named(tree: str, path: Path) -> None:
    """A generator draws other numbers in another type, and the default type of torch may be another one."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("torch.rand", "torch.randn"):
            assert "dtype" in {one.arg for one in node.keywords}, ast.unparse(node)


@pytest.mark.parametrize("tree", LAYERS)
def test_every_module_has_a_layer(tree: str) -> None:
    layers = {layer(tree, name(tree, path)) for path in MODULES[tree]} - DOORS[tree]
    assert layers == set(LAYERS[tree]), "a folder or module has no layer, or a layer has no module"


@pytest.mark.parametrize("tree", LAYERS)
def test_the_map_for_readers_has_the_same_order(tree: str) -> None:
    """The table in the tree's README; that of `experiments` has no files, but a folder without code."""
    rows = re.findall(r"^\| ((?:`[\w/]+(?:/|\.py)`(?:, )?)+) \|", (ROOT / tree / "README.md").read_text(), re.MULTILINE)
    listed = [one.replace("/", ".") for row in rows for one in re.findall(r"`([\w/]+?)(?:/|\.py)`", row)]
    folders = [one for one in LAYERS[tree] if (ROOT / tree / one).is_dir() or tree == "torch_zerohess"]
    assert [one for one in listed if one != "results"] == folders


@pytest.mark.parametrize(("tree", "path"), CASES)
def test_imports_go_one_way(tree: str, path: Path) -> None:
    own = name(tree, path)
    if own in DOORS[tree]:  # a door to everything
        return
    layers, below = LAYERS[tree], layer(tree, own)
    for other in imported(tree, path):
        assert other not in DOORS[tree], f"{own} imports from the door {tree}.{other}: import from the module itself"
        above = layer(tree, other)
        allowed = above == below or layers.index(above) < layers.index(below)  # within a folder: see the next test
        assert allowed, f"{own} imports {other}, which comes after it"


@pytest.mark.parametrize("tree", LAYERS)
def test_no_import_cycle(tree: str) -> None:
    graph = {name(tree, path): imported(tree, path) for path in MODULES[tree] if name(tree, path)}
    done: set[str] = set()
    while len(done) < len(graph):
        ready = {module for module in graph if module not in done and graph[module] - {module} <= done}
        assert ready, f"import cycle among {sorted(set(graph) - done)}"
        done |= ready


def test_the_library_knows_nothing_of_the_experiments() -> None:
    for path in MODULES["torch_zerohess"]:
        assert "experiments" not in {
            full.split(".")[0]
            for node in ast.walk(ast.parse(path.read_text()))
            for full in (
                [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else []
            )
        }


@pytest.mark.parametrize(("tree", "path"), CASES)
def test_modules_are_small_and_say_what_they_are(tree: str, path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) <= MOST_LINES
    assert ast.get_docstring(ast.parse(text)), "a module begins with what it is about"


# Private modules and attributes of torch, and private members of its objects. `torch_zerohess._C` is ours.
PRIVATE = re.compile(
    r"\b(torch\._(?!_version__)\w+|forward_ad\._\w+|_functorch|_subclasses|_is_zerotensor|_backward_cls|(?<=\.)_version)\b"
)


def test_private_names_of_torch_are_in_one_file_but_for_one() -> None:
    found = {name("torch_zerohess", path): PRIVATE.findall(path.read_text()) for path in MODULES["torch_zerohess"]}
    assert found.pop("autograd.transforms"), "the file that may use them has none: the pattern finds nothing"
    assert found.pop("estimation.inputs") == ["_version"]
    assert not {module: names for module, names in found.items() if names}, "they belong into autograd/transforms.py"


LOADED = """
import sys
import torch
before = set(sys.modules)
import torch_zerohess
print("\\n".join(sorted(set(sys.modules) - before)))
"""


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, check=True)


def test_import_loads_nothing_but_torch_and_the_standard_library() -> None:
    loaded = run("-W", "error", "-c", LOADED).stdout.split()
    assert "torch_zerohess" in loaded
    assert {module.split(".")[0] for module in loaded} - {"torch_zerohess", "torch"} - set(
        sys.stdlib_module_names
    ) == set()
    # Nor the parts of torch that a plain `import torch` leaves alone because they are slow: import never compiles.
    assert not [module for module in loaded if module.startswith(("torch.utils.cpp", "torch._inductor"))]
