"""What this installation can do."""

import importlib.metadata
import platform
from dataclasses import dataclass, field

import torch

from torch_zerohess.adapters import mitsuba_variants
from torch_zerohess.sampling import extension

_OPTIONAL = ("mitsuba", "drjit", "onnxruntime", "numpy")


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

    def __str__(self) -> str:
        lines = ["torch_zerohess " + self.versions.get("torch_zerohess", "(not installed)")]
        lines.append(f"C++ extension  {'used' if self.extension else 'not used'}: {self.extension_status}")
        lines.append(f"devices        {', '.join(self.devices)}")
        lines += [f"mitsuba        {name}: {status}" for name, status in self.mitsuba.items()]
        lines += [f"version        {name} {version}" for name, version in self.versions.items()]
        return "\n".join(lines + [f"advice         {one}" for one in self.advice])


def doctor() -> Report:
    """Find out what works here; nothing it tries can abort the process. Takes some seconds where Mitsuba is installed.

    Example:
        >>> doctor().devices[0]
        'cpu'
    """
    versions = {"python": platform.python_version()}
    versions |= {name: version for name in ("torch_zerohess", "torch", *_OPTIONAL) if (version := _version(name))}
    devices = ["cpu"] + [f"cuda:{i} ({torch.cuda.get_device_name(i)})" for i in range(torch.cuda.device_count())]
    variants = {name: "works" if probe.works else probe.reason for name, probe in mitsuba_variants.variants().items()}
    advice = [] if extension.available else [f"for the C++ extension, {extension.HINT}"]
    return Report(extension.available, extension.status, devices, variants, versions, advice)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
