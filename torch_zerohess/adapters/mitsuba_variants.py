"""Which Mitsuba variant is safe here: an LLVM that is too old aborts the whole process, so every try runs in a child.

`llvm_ad_rgb` is several times faster than `scalar_rgb`, but Dr.Jit hands LLVM code that LLVM 14 and 15 do not
compile ("Cannot select: fminimum", then `abort()`). `select_variant` therefore takes `llvm_ad_rgb` only with
a library of a version known to be new enough that also passes a tiny render in a child process, and the embedded
`scalar_rgb`, which needs nothing, in all other cases.
"""

import ctypes.util
import importlib.util
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

from torch_zerohess.arguments import checked_integer
from torch_zerohess.evaluators.lifetime import ending

MINIMUM_LLVM = 16
CANDIDATES = ("scalar_rgb", "llvm_ad_rgb", "cuda_ad_rgb")
LLVM = f"LLVM {MINIMUM_LLVM} or newer (Debian: apt-get install libllvm19, macOS: brew install llvm)"
INSTALL = "mitsuba is not installed; pip install mitsuba"

_DRIVERS = ("cuda", "nvcuda")
"""Names of the library of the NVIDIA driver: of Linux, and of Windows."""
_FOLDERS = (
    "/usr/lib",
    "/usr/lib/*-linux-gnu*",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
_NAME = re.compile(r"^libLLVM[-.](?:so\.|dylib\.)?(\d+)(?=[.\-]|$)")

# What the child runs: the smallest scene with a shape, a light and a path, so that LLVM has to compile real kernels.
_CHILD = """
import sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
import mitsuba as mi
mi.set_variant(sys.argv[1])
scene = mi.load_dict({
    "type": "scene",
    "integrator": {"type": "path", "max_depth": 2},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 2, "height": 2}},
    "ball": {"type": "sphere", "center": [0.0, 0.0, 4.0]},
    "light": {"type": "constant"},
})
if not float(mi.TensorXf(mi.render(scene, spp=1)).array[0]) > 0.0:
    sys.exit("the test image is black")
"""


@dataclass(frozen=True)
class Probe:
    """Outcome of a try of one variant: whether it `works`, and if not the `reason` (empty when it works)."""

    works: bool
    reason: str


def find_llvm() -> Path | None:
    """Newest libLLVM shared library with a known major version of at least `MINIMUM_LLVM`.

    The library that `DRJIT_LIBLLVM_PATH` names is preferred when it qualifies; then come the usual folders of Linux
    and of Homebrew. The version is read from the file name or from the name of what a symbolic link points to; a
    library of unknown version is never a candidate.

    Returns: path of the library, or None when there is none.
    """
    asked = os.environ.get("DRJIT_LIBLLVM_PATH")
    if asked and Path(asked).is_file() and _major(Path(asked)) >= MINIMUM_LLVM:
        return Path(asked)
    # Sorted by version, then by path, so that the choice does not depend on the order of the directory entries.
    found = sorted((_major(path), str(path)) for path in _libraries())
    if found and found[-1][0] >= MINIMUM_LLVM:
        return Path(found[-1][1])
    return None


@cache
def probe(variant: str, llvm: Path | None = None, timeout: float = 60.0) -> Probe:
    """Try a variant on a 2x2 image in a child process, so that an abort there never reaches the caller.

    Args:
        variant: name of a Mitsuba variant, such as `"llvm_ad_rgb"`.
        llvm: library for the child's `DRJIT_LIBLLVM_PATH`; None leaves the choice to Dr.Jit.
        timeout: seconds after which the child is killed and the variant counts as not working.

    Returns: the `Probe`; remembered per arguments, since a try costs one to two seconds.

    """
    if importlib.util.find_spec("mitsuba") is None:
        return Probe(False, INSTALL)
    environment = dict(os.environ)
    if llvm is not None:
        environment["DRJIT_LIBLLVM_PATH"] = str(llvm)
    try:
        child = subprocess.run(
            [sys.executable, "-c", _CHILD, variant],
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Probe(False, f"the test render did not end within {timeout:g} s")
    if child.returncode == 0:
        return Probe(True, "")
    return Probe(False, _reason(child.returncode, child.stderr))


def variants() -> dict[str, Probe]:
    """Probe of each of `CANDIDATES`, all tried at the same time; never aborts, never raises.

    Returns: name -> `Probe`; what `select_variant("auto")` would not take for lack of LLVM does not work.
    """
    with ThreadPoolExecutor(len(CANDIDATES)) as pool:
        return dict(zip(CANDIDATES, pool.map(_safe, CANDIDATES), strict=True))


def select_variant(variant: str = "auto", threads: int | None = None) -> ModuleType:
    """Set a variant that is known to work in this process, and return the `mitsuba` module.

    `DRJIT_LIBLLVM_PATH` is set to what `find_llvm` returns, with a warning if it named another library.

    Args:
        variant: `"auto"` (`llvm_ad_rgb` where that is safe, else `scalar_rgb`) or the name of a variant.
        threads: render threads of this process, at least 1; None keeps Dr.Jit's own choice (all cores). One thread in
            each of several processes uses the cores best.

    Raises:
        ModuleNotFoundError: Mitsuba is not installed.
        ValueError, TypeError: `threads` is below 1, or no integer.
        RuntimeError: the variant asked for does not work here; the message has the reason and what to do.

    """
    if threads is not None:
        threads = checked_integer("threads", threads, 1)
    if importlib.util.find_spec("mitsuba") is None:
        raise ModuleNotFoundError(INSTALL, name="mitsuba")
    if variant == "auto":
        variant = "llvm_ad_rgb" if _safe("llvm_ad_rgb").works else "scalar_rgb"
    elif variant != "scalar_rgb":
        outcome = _try(variant)
        if not outcome.works:
            advice = "take one of these" if "unsupported variant" in outcome.reason else _advice(variant)
            raise RuntimeError(f"variant {variant!r} does not work here: {outcome.reason.rstrip('.')}; {advice}")
    llvm = find_llvm()
    if llvm is not None:  # read once, when Dr.Jit first needs LLVM
        asked = os.environ.get("DRJIT_LIBLLVM_PATH")
        if asked and Path(asked) != llvm:
            warnings.warn(
                f"DRJIT_LIBLLVM_PATH must name a file that is LLVM {MINIMUM_LLVM} or newer by its name, got {asked}: "
                f"{llvm} is used instead",
                UserWarning,
                stacklevel=2,
            )
        os.environ["DRJIT_LIBLLVM_PATH"] = str(llvm)
    import drjit
    import mitsuba

    if mitsuba.variant() != variant:
        mitsuba.set_variant(variant)
    if threads is not None:
        drjit.set_thread_count(threads)
    return mitsuba


def _safe(variant: str) -> Probe:
    """Try a variant only where the library that it needs is there, and is known to be new enough."""
    if importlib.util.find_spec("mitsuba") is None:
        return Probe(False, INSTALL)
    if variant.startswith("llvm") and find_llvm() is None:
        return Probe(False, f"no LLVM {MINIMUM_LLVM} or newer was found")
    if variant.startswith("cuda") and not any(map(ctypes.util.find_library, _DRIVERS)):
        return Probe(False, "no NVIDIA driver was found")
    return _try(variant)


def _try(variant: str) -> Probe:
    return probe(variant, find_llvm() if variant.startswith("llvm") else None)


def _advice(variant: str) -> str:
    if variant.startswith("llvm"):
        return f'install {LLVM}, point DRJIT_LIBLLVM_PATH to its libLLVM, or use variant="scalar_rgb"'
    return 'use variant="auto" or "scalar_rgb"'


def _libraries() -> Iterator[Path]:
    for folder in _FOLDERS:
        for pattern in ("libLLVM*.so*", "libLLVM*.dylib"):
            for path in Path("/").glob(f"{folder[1:]}/{pattern}"):
                if path.is_file():
                    yield path


def _major(path: Path) -> int:
    """Major version in the name of `path` or of the file it links to; 0 when neither says."""
    for name in (path.resolve().name, path.name):
        match = _NAME.match(name)
        if match:
            return int(match.group(1))
    return 0


def _reason(returncode: int, stderr: str) -> str:
    """The telling line of a failed child: its first error line, else its last line, after the signal that ended it."""
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    telling = [line for line in lines if re.match(r"(LLVM ERROR|\w*(Error|Exception)\b):", line)] or lines[-1:]
    line = telling[0] if telling else "no message"
    if returncode >= 0:
        return line
    return f"killed by {ending(returncode)}: {line}"
