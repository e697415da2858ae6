"""The trained network outside torch: ONNX, run by onnxruntime."""

import importlib.util
import logging
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

NEEDED = ("onnx", "onnxruntime", "onnxscript")
TOLERANCE = 1e-4


def missing() -> list[str]:
    """Packages of the extra `onnx` that are not installed."""
    return [name for name in NEEDED if importlib.util.find_spec(name) is None]


def export(encoder: nn.Module, images: Tensor, path: Path) -> float:
    """Write an encoder as ONNX with a free batch size and return the largest difference of its predictions there.

    images: [B, 3, h, w], on which torch and onnxruntime are compared. Raises RuntimeError if they differ by more than
    1e-4, ImportError if a package of the extra `onnx` is missing.
    """
    if missing():
        raise ImportError(f"ONNX export needs {', '.join(missing())}: pip install '.[onnx]'")
    import onnxruntime

    encoder.eval()
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), torch.no_grad():
        # Deprecations inside the exporter are not ours to act on.
        warnings.simplefilter("ignore", category=(DeprecationWarning, FutureWarning, UserWarning))
        torch.onnx.export(
            encoder,
            (images[:2],),
            str(path),
            dynamo=True,
            external_data=False,
            verbose=False,
            input_names=["image"],
            output_names=["parameters"],
            dynamic_shapes=({0: torch.export.Dim("batch")},),
        )
        expected = encoder(images)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"image": images.numpy()})
    difference = float((torch.from_numpy(found) - expected).abs().max())
    if difference > TOLERANCE:
        raise RuntimeError(f"onnxruntime predicts up to {difference} away from torch; {TOLERANCE} is allowed")
    return difference
