"""Modules of torch outside of their training: no sample depends on others, and nothing is drawn."""

import contextlib
from collections.abc import Iterator

from torch import nn

BATCH_NORMS = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d, nn.SyncBatchNorm)


def mixes_in_evaluation(module: nn.Module) -> str | None:
    """Return what of a module mixes samples in evaluation mode, too: batch normalisation without running statistics."""
    for name, one in module.named_modules():
        if isinstance(one, BATCH_NORMS) and one.running_mean is None:
            return (
                f"a {type(one).__name__} without running statistics ({name!r}), which mixes samples in evaluation mode"
            )
    return None


@contextlib.contextmanager
def evaluation_mode(module: nn.Module) -> Iterator[None]:
    """Put a module and its parts into evaluation mode for a while, and each back into its own mode afterwards."""
    trained = [one for one in module.modules() if getattr(one, "training", False)]  # a frozen script has no mode
    try:
        for one in trained:
            one.training = False
        yield
    finally:
        for one in trained:
            one.training = True
