"""One render of a Mitsuba scene; where Mitsuba refuses it, the message has the cause and the remedy."""

from typing import Any


def rendered(mi: Any, scene: Any, **settings: Any) -> Any:
    """Return what `mitsuba.render` does for a scene.

    RuntimeError with the cause where Mitsuba raises one: just-in-time variants say "see above" in its place, because
    the cause is in the exception before. They trace the objects of all scenes that the process holds, so the cause may
    be in another scene.
    """
    try:
        return mi.render(scene, **settings)
    except RuntimeError as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        said = " ".join(str(cause).split())  # descriptions of textures have lines of their own
        advice = _advice(said.lower(), spectral="spectral" in mi.variant())
        if "_ad_" in mi.variant():
            advice += " (it may be in another scene: these variants trace all that the process holds, so delete it)"
        raise RuntimeError(f"Mitsuba cannot render the scene with variant {mi.variant()!r}: {said}{advice}") from error


def _advice(cause: str, *, spectral: bool) -> str:
    """Return what to do about a cause in lower case; empty if nothing is known."""
    if spectral and "raw=true" in cause:
        return '; leave "raw" out of the description of the texture, or take a variant of colours, as "llvm_ad_rgb"'
    if not spectral and "spectrum" in cause and "not implemented" in cause:
        return (
            "; a spectrum of wavelengths needs a variant of spectra: take one, as "
            'variant="llvm_ad_spectral", or describe the colour as {"type": "rgb", "value": [...]}'
        )
    return ""
