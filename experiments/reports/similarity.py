"""How alike two pictures are, by the measures of scikit-image: PSNR and SSIM."""

import math

from torch import Tensor

WINDOW = 11
"""Pixels along a window of SSIM."""


def measures(picture: Tensor, target: Tensor) -> dict[str, float]:
    """Return "PSNR" in dB, infinite for equal pictures, and "SSIM" of [h, w] or [h, w, 3] in [0, 1].

    Values outside of [0, 1] are clipped, as they are shown. SSIM has the Gaussian windows of Wang et al. (2004), as
    `zh.losses.ssim`; it is left out where a picture is smaller than a window.
    """
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    if picture.shape != target.shape:
        raise ValueError(f"picture must have the shape {list(target.shape)} of the target, got {list(picture.shape)}")
    one, other = (image.detach().double().clamp(0, 1).cpu().numpy() for image in (picture, target))
    equal = bool((one == other).all())
    found = {"PSNR": math.inf if equal else float(peak_signal_noise_ratio(other, one, data_range=1.0))}
    if min(one.shape[:2]) >= WINDOW:
        found["SSIM"] = float(
            structural_similarity(
                one,
                other,
                gaussian_weights=True,
                sigma=1.5,
                use_sample_covariance=False,
                data_range=1.0,
                channel_axis=-1 if one.ndim == 3 else None,
            )
        )
    return found


def described(found: dict[str, float]) -> str:
    """Return measures as text.

    Example:
        >>> described({"PSNR": 31.25, "SSIM": 0.98765, "distance": 0.00123})
        'PSNR 31.2 dB, SSIM 0.988, distance 0.00123'
    """
    formats = {"PSNR": "{:.1f} dB", "SSIM": "{:.3f}"}
    return ", ".join(f"{name} {formats.get(name, '{:.3g}').format(value)}" for name, value in found.items())
