"""What a user meets on installing: with and without a compiler, without torch, and what `doctor` says."""

import contextlib
import importlib.metadata
import io
import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import setuptools

import torch_zerohess as zh
from torch_zerohess.adapters import mitsuba_variants

ROOT = Path(__file__).parents[2]
VALUES = """
import torch, torch_zerohess as zh
e = zh.estimate(lambda z: z.sin().sum(1), torch.linspace(0, 1, 9).double(), zh.Smoothing(sigma=0.5, samples=32, seed=3))
sums = e.gradient.sum(), e.hessian().sum(), e.hvp(torch.ones(9)).sum()
print(e.points.sum().item().hex(), *(f"{v:.12g}" for v in sums))
"""


def python(code: str, *, folder: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder), **environment},
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )


def source(folder: Path) -> Path:
    """A copy of what an installation is built from, without anything built."""
    copy = folder / "source"
    copy.mkdir()
    for name in ("setup.py", "pyproject.toml", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    for name in ("torch_zerohess", "csrc"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("_C*", "__pycache__"))
    return copy


MACROS = {
    *("STABLE_TORCH_LIBRARY", "STABLE_TORCH_LIBRARY_FRAGMENT", "STABLE_TORCH_LIBRARY_IMPL", "TORCH_BOX"),
    *("STD_TORCH_CHECK", "TORCH_ERROR_CODE_CHECK"),
}
"""Of the headers of torch 2.10, the oldest release that `setup.py` builds for."""


def test_extension_uses_macros_that_the_oldest_torch_has():
    """`TORCH_TARGET_VERSION` hides newer functions from the compiler, but no newer macros."""
    code = "\n".join(path.read_text() for path in (ROOT / "csrc").iterdir())
    assert set(re.findall(r"\b(?:\w+_)?TORCH_(?!ZEROHESS)[A-Z_]+\b", code)) == MACROS


def test_extension_is_built_and_doctor_says_so():
    report = zh.doctor()
    assert report.extension
    assert report.versions["torch"] == importlib.metadata.version("torch")
    assert report.devices[0] == "cpu"
    assert "scalar_rgb" in report.mitsuba
    assert "C++ extension  used" in str(report)


def test_the_package_as_a_program_prints_the_report(capsys, monkeypatch):
    monkeypatch.setattr(
        "torch_zerohess.adapters.mitsuba_variants.probe", lambda *_: mitsuba_variants.Probe(False, "no")
    )
    runpy.run_path(str(ROOT / "torch_zerohess" / "__main__.py"), run_name="__main__")
    assert capsys.readouterr().out == f"{zh.doctor()}\n"


def test_doctor_says_what_to_install_for_what_is_missing(monkeypatch):
    required = ["torch>=2.10", 'numpy; extra == "onnx"', 'nonesuch>=1; extra == "onnx"', 'absent; extra == "test"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: required)
    monkeypatch.setattr(
        "torch_zerohess.adapters.mitsuba_variants.probe", lambda *_: mitsuba_variants.Probe(False, "no")
    )
    report = zh.doctor()
    assert report.mitsuba["scalar_rgb"] == "no"
    assert [one for one in report.advice if "pip" in one] == ["for onnx: pip install nonesuch"]
    assert any("apt-get install libllvm19" in one for one in report.advice)


@pytest.fixture(scope="module")
def numbers() -> str:
    """What the extension prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(VALUES, {})
    return printed.getvalue()


def test_pure_torch_gives_the_same_numbers(numbers):
    pure = python(VALUES, TORCH_ZEROHESS_PURE_TORCH="1")
    assert pure.returncode == 0, pure.stderr
    assert numbers == pure.stdout


def test_without_the_extension_one_warning_and_it_works(tmp_path, numbers):
    folder = source(tmp_path)
    # An editable installation finds the extension of the original for the copy too.
    alone = "import sys; sys.meta_path[:] = [one for one in sys.meta_path if 'editable' not in repr(one).lower()]"
    done = python(alone + VALUES + "print(zh.doctor().extension, zh.doctor().advice)", folder=folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("RuntimeWarning") == 1
    assert "install a C++20 compiler" in done.stderr
    first, second = done.stdout.splitlines()
    assert first + "\n" == numbers
    assert second.startswith("False")
    assert "reinstall" in second


def wheel(folder: Path, **environment: str) -> tuple[subprocess.CompletedProcess[str], set[str]]:
    command = [sys.executable, "-m", "pip", "wheel", "-v", "--no-build-isolation", "--no-deps", "-w", "wheels", "."]
    done = subprocess.run(
        command, cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True, timeout=250, check=False
    )
    built = list((folder / "wheels").glob("*.whl"))
    return done, set(zipfile.ZipFile(built[0]).namelist()) if built else set()


def test_wheel_has_one_binary_for_many_pythons(tmp_path):
    """Compiled without optimization, which takes a third of the time."""
    compiler = tmp_path / "compiler"
    compiler.write_text('#!/bin/sh\nexec g++ "$@" -O0\n')
    compiler.chmod(0o755)
    done, names = wheel(source(tmp_path), CC=str(compiler), CXX=str(compiler))
    assert done.returncode == 0, done.stdout + done.stderr
    assert any(name.startswith("torch_zerohess/_C.abi3.") for name in names)
    assert "torch_zerohess/py.typed" in names
    assert not any(name.startswith(("tests", "experiments")) for name in names)


def test_install_succeeds_without_a_compiler(tmp_path):
    done, names = wheel(source(tmp_path), CC="/nonexistent/cc", CXX="/nonexistent/c++")
    assert done.returncode == 0, done.stdout + done.stderr
    assert any(name.endswith("torch_zerohess/__init__.py") for name in names)
    assert not any("_C" in name for name in names)
    assert "WARNING: torch_zerohess: the C++ extension was not built" in done.stdout + done.stderr


def test_missing_torch_names_the_command(tmp_path):
    """In an environment that has setuptools and nothing else."""
    site = tmp_path / "site"
    site.mkdir()
    for name in ("setuptools", "_distutils_hack"):
        package = Path(setuptools.__file__).parent.parent / name
        if package.exists():
            (site / name).symlink_to(package)
    environment = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True)
    done = subprocess.run(
        [str(environment / "bin" / "python"), "setup.py", "bdist_wheel"],
        cwd=source(tmp_path),
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode != 0
    assert "pip install 'torch>=2.10'" in done.stderr


def test_a_source_distribution_has_the_extension_and_no_tests(tmp_path):
    """Without `MANIFEST.in` it has those tests alone that lie in no folder."""
    folder = source(tmp_path)
    (folder / "tests").mkdir()
    shutil.copy(ROOT / "tests" / "test_architecture.py", folder / "tests")
    subprocess.run([sys.executable, "setup.py", "-q", "sdist"], cwd=folder, check=True, capture_output=True)
    (archive,) = (folder / "dist").iterdir()
    with tarfile.open(archive) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    needed = {str(path.relative_to(ROOT)) for path in (ROOT / "csrc").iterdir()}
    needed |= {
        "setup.py",
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "torch_zerohess/py.typed",
        "torch_zerohess/README.md",
    }
    assert needed <= names
    assert not any(name.startswith("tests") for name in names)


def test_the_package_says_its_version():
    assert zh.__version__ == importlib.metadata.version("torch_zerohess")
