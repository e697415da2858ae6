"""Build of the C++ extension; everything else stands in pyproject.toml.

The extension needs the headers and libraries of torch, not torch itself: they are looked up without importing it, also
from inside pip's isolated build environment, which hides the packages of the environment that is installed into.
"""

import importlib.util
import re
import sys
import sysconfig
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

TORCH = "torch>=2.10"
STABLE_ABI = "0x020a000000000000"  # torch 2.10, the oldest release whose stable ABI has parallel_for
PYTHON_ABI = "0x030a0000"  # Python 3.10
FREE_THREADED = bool(sysconfig.get_config_var("Py_GIL_DISABLED"))  # these Pythons have no limited API
LIMITED_API = [] if FREE_THREADED else [("Py_LIMITED_API", PYTHON_ABI)]
UNIX_FLAGS = [
    "-std=c++20",
    "-O3",
    "-fvisibility=hidden",
    # The same bits on every processor: no contraction. The rest lets loops vectorize and changes no result.
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
]
WINDOWS_FLAGS = ["/std:c++20", "/O2", "/fp:precise"]


def find_torch() -> Path | None:
    """Folder of the torch package that the extension will run with, or of the one in the build environment."""
    installed = [Path(sysconfig.get_path(key)) / "torch" for key in ("platlib", "purelib")]
    spec = importlib.util.find_spec("torch")
    if spec and spec.origin:
        installed.append(Path(spec.origin).parent)
    return next((folder for folder in installed if recent(folder)), None)


def recent(folder: Path) -> bool:
    """Whether a folder has torch 2.10 or later with its headers."""
    version = re.search(r"__version__ = '(\d+)\.(\d+)", _text(folder / "version.py"))
    headers = (folder / "include/torch/csrc/stable/library.h").exists()
    return headers and version is not None and tuple(map(int, version.groups())) >= (2, 10)


def _text(path: Path) -> str:
    return path.read_text() if path.exists() else ""


class BuildIfPossible(build_ext):
    """An extension that cannot be compiled is left out with one warning: the package works without it, only slower."""

    def build_extension(self, ext: Extension) -> None:
        try:
            super().build_extension(ext)
        except Exception as error:  # any compiler, linker or missing-tool failure
            print(
                f"\nWARNING: torch_zerohess: the C++ extension was not built ({error}).\n"
                "The package works without it through slower pure-torch code. To get it, install a C++20 compiler "
                "(Debian: apt-get install g++) and reinstall: pip install --force-reinstall --no-deps .\n",
                file=sys.stderr,
            )
            self.extensions.remove(ext)


def extension(torch: Path) -> Extension:
    windows = sys.platform == "win32"
    return Extension(
        "torch_zerohess._C",
        sources=["csrc/ops.cpp", "csrc/sparse_ops.cpp"],
        depends=[str(path) for path in sorted(Path("csrc").glob("*.h"))],
        include_dirs=[str(torch / "include")],
        library_dirs=[str(torch / "lib")],
        libraries=["torch", "torch_cpu", "c10"],
        define_macros=[("TORCH_TARGET_VERSION", STABLE_ABI), *LIMITED_API],
        extra_compile_args=WINDOWS_FLAGS if windows else UNIX_FLAGS,
        py_limited_api=not FREE_THREADED,
    )


torch = find_torch()
COMMANDS = ("bdist", "build", "install", "develop", "editable", "sdist")  # which need the headers, or name them
building = any(command.startswith(COMMANDS) for command in sys.argv[1:])
if torch is None and building:
    sys.exit(
        f"torch_zerohess needs torch to build. Run: pip install '{TORCH}'   and then install torch_zerohess again."
    )

setup(
    # Asked for by pip's isolated build only when the environment has no torch of its own.
    setup_requires=[] if torch else [TORCH],
    ext_modules=[extension(torch)] if torch else [],
    cmdclass={"build_ext": BuildIfPossible},
    options={} if FREE_THREADED else {"bdist_wheel": {"py_limited_api": "cp310"}},
)
