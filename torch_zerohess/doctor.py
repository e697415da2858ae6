"""What this installation can do."""

import importlib.metadata
import platform
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch

from torch_zerohess.adapters import mitsuba_variants
from torch_zerohess.sampling import extension
from torch_zerohess.version import installed_version

_OPTIONAL = ("mitsuba", "drjit", "onnxruntime", "numpy")
_NAME = "torch_zerohess"
_DEVELOPERS = "test", "experiments", "rivals"
"""The extras that only those need who have a clone of this package: an installation has no tests and experiments."""


@dataclass(frozen=True)
class Report:
    """The findings of `doctor`; printing it gives a page to read or to send with a question."""

    extension: bool
    """Whether the C++ extension is used."""
    extension_status: str
    devices: list[str]
    """Devices that torch can use."""
    mitsuba: dict[str, str]
    """Mitsuba variants of interest and "works" or the reason why not."""
    versions: dict[str, str]
    """Installed packages; those that are missing are left out."""
    advice: list[str] = field(default_factory=list)
    """What to install, with the command."""

    def __str__(self) -> str:
        lines = ["torch_zerohess " + self.versions.get("torch_zerohess", "(not installed)")]
        lines.append(f"C++ extension  {'used' if self.extension else 'not used'}: {self.extension_status}")
        lines.append(f"devices        {', '.join(self.devices)}")
        lines += [f"mitsuba        {name}: {status}" for name, status in self.mitsuba.items()]
        lines += [f"version        {name} {version}" for name, version in self.versions.items()]
        return "\n".join(lines + [f"advice         {one}" for one in self.advice])


def doctor() -> Report:
    """Find out what works here; nothing it tries can abort the process. Takes some seconds where Mitsuba is installed.

    `print(doctor())` prints the report, and so does `python -m torch_zerohess`.

    Example:
        >>> doctor().devices[0]
        'cpu'
    """
    versions = {"python": platform.python_version()}
    versions |= {name: version for name in (_NAME, "torch", *_OPTIONAL) if (version := installed_version(name))}
    devices = ["cpu"] + [f"cuda:{i} ({torch.cuda.get_device_name(i)})" for i in range(torch.cuda.device_count())]
    probes = mitsuba_variants.variants()
    variants = {name: "works" if one.works else one.reason for name, one in probes.items()}
    advice = [] if extension.available else [f"for the C++ extension, {extension.HINT}"]
    if "mitsuba" in versions and not probes["llvm_ad_rgb"].works:
        advice.append(f"for fast renders with derivatives, {mitsuba_variants.LLVM}")
    advice += [f"for {extra}: pip install {' '.join(names)}" for extra, names in _missing()]
    return Report(extension.available, extension.status, devices, variants, versions, advice)


def _missing() -> Iterator[tuple[str, list[str]]]:
    """Yield the extras that name a package that is not installed, with these packages: each under its first extra."""
    seen: set[str] = set()
    for extra, packages in _extras().items():
        names = [one for one in packages if one not in seen and not installed_version(one)]
        seen.update(packages)
        if names:
            yield extra, names


def _extras() -> dict[str, list[str]]:
    """Packages of every extra of this one, without those that another extra brings."""
    try:
        required = importlib.metadata.requires(_NAME) or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    found: dict[str, list[str]] = {}
    for one in required:
        name = re.match(r"[\w.-]+", one)
        extra = re.search(r"""extra == ["']([\w-]+)["']""", one)
        if name and extra and extra[1] not in _DEVELOPERS and name[0].replace("-", "_") != _NAME:
            found.setdefault(extra[1], []).append(name[0])
    return found
