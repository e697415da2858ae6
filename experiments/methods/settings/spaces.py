"""What `python -m experiments tune` chooses settings from."""

from collections.abc import Mapping
from typing import Any

from experiments.methods.settings.ours import SEARCHES

Space = Mapping[str, tuple[Any, ...]]

_ADAM: Space = {
    "samples": (1, 2, 4, 6),
    "learning_rate": (0.001, 0.002, 0.005, 0.01, 0.02, 0.05),
    "sigma": ((1.0, 1e-4), (1.0, 0.01), (1.0, 0.1), (0.5, 0.01), (1.5, 0.01)),
    "steps": (300, 1000, 3000),
}
_LINE_SEARCH: Space = {
    "samples": (1, 2, 4, 6, 12),
    "trust_region": (0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
    "sigma": ((1.0, 1e-4), (1.0, 0.01), (1.0, 0.1), (0.5, 0.01), (1.5, 0.01)),
    "line_search": ((1, 0.0), (3, 0.0), (10, 0.0)),
    "recompute": (1, 5, 10, 30),
    "modification": ("abs", "radius"),
    "baseline": ("center", "mean"),
    "steps": (20, 40, 80, 160, 320),
}
_QUASI_NEWTON: Space = {
    "samples": (2, 4, 8),
    "start": (0.5, 1.0),
    "end": (0.01, 0.1),
    "steps": (20, 50, 100, 300),
}
_BFGS: Space = {**_QUASI_NEWTON, "longest": (0.5, 1.0, 2.0)}
_LBFGS: Space = {**_QUASI_NEWTON, "inner": (2, 5, 10)}

_SEARCH: Space = {"sigma": (0.7, 1.0, 1.2, 1.4, 1.8, 2.5)}
_SCALE: Space = {"scale": (0.1, 0.25, 0.5, 1.0, 2.0)}
_DIFFERENCE: Space = {"difference": (1e-6, 1e-4, 1e-2, 0.1, 0.3)}
_ADAPTIVE: Space = {"samples": (1, 4, 16), "start": (0.1, 1.0), "end": (0.01, 0.1), "steps": (5, 20, 50)}
_ADJOINT: Space = {"rate": (0.03, 0.1, 0.2, 0.3, 0.5, 1.0), "steps": (50, 100, 300), "fresh": (True, False)}
_ZEROGRADS: Space = {
    "pairs": (1, 2, 5),
    "sigma": ((0.33, 0.33), (0.33, 0.03), (1.0, 0.1), (1.0, 0.03)),
    "steps": (20, 50, 100, 300),
    "rate": (0.02, 0.05, 0.1, 0.2),
    "fit_rate": (1e-3, 3e-3, 1e-2),
    "fits": (3, 10, 30),
    "hidden": ((64, 64, 64), (32, 32)),
}
_RELAX: Space = {
    "samples": (2, 4, 8, 16),
    "sigma": ((1.0, 0.1), (1.0, 0.01), (0.5, 0.03), (0.25, 0.25)),
    "steps": (20, 50, 100, 300),
    "rate": (0.03, 0.1, 0.2, 0.4),
    "fit_rate": (0.01, 0.03, 0.1),
    "hidden": ((10,), (64,), (10, 10)),
}

SPACES: Mapping[str, Space] = {
    **dict.fromkeys(("fr22", "our_g"), _ADAM),
    **dict.fromkeys(("our_h", "our_hvp", "our_hvpa"), _LINE_SEARCH),
    **dict.fromkeys(SEARCHES, _SEARCH),
    **dict.fromkeys(("bfgs", "bfgs_wolfe", "bfgs_damped"), _BFGS),
    **dict.fromkeys(("bfgs_frozen", "bfgs_wolfe_frozen", "bfgs_damped_frozen"), _BFGS),
    **dict.fromkeys(("lbfgs", "lbfgs_frozen"), _LBFGS),
    **dict.fromkeys(("bfgs_adaptive_fd", "bfgs_adaptive_fd_frozen"), _ADAPTIVE),
    **dict.fromkeys(("bfgs_fd", "lbfgs_fd"), _DIFFERENCE),
    **dict.fromkeys(("cma_es", "cma_es_bounded", "cobyqa", "dfo_ls"), _SCALE),
    **dict.fromkeys(("mitsuba", "mitsuba_path", "mitsuba_projective"), _ADJOINT),
    "py_bobyqa": {**_SCALE, "seek_global_minimum": (True, False)},
    "zerograds": _ZEROGRADS,
    "relax": _RELAX,
    "analytic_1": {"rate": (0.03, 0.1, 0.3), "steps": (50, 300)},
    "analytic_2": {"radius": (0.5, 1.0, 2.0, 5.0, 100.0), "steps": (3, 10)},
}
"""Choices by method and setting; lengths that depend on the task are in units of its sigma."""
LENGTHS: Mapping[str, tuple[str, ...]] = {
    "fr22": ("learning_rate", "sigma"),
    "our_g": ("learning_rate", "sigma"),
    "our_h": ("trust_region", "sigma"),
    "our_hvp": ("sigma",),
    "our_hvpa": ("sigma",),
    **dict.fromkeys(SEARCHES, ("sigma",)),
}
"""Settings that are lengths, by method."""


def space(method: str, sigma: float) -> dict[str, tuple[Any, ...]]:
    """Return the search space of a method on a task with this sigma; SystemExit if it has none."""
    if method not in SPACES:
        raise SystemExit(f"method must be one that can be tuned, {', '.join(SPACES)}, got {method}")
    lengths = LENGTHS.get(method, ())
    return {
        name: tuple(_scaled(choice, sigma) for choice in choices) if name in lengths else choices
        for name, choices in SPACES[method].items()
    }


def _scaled(choice: Any, sigma: float) -> Any:
    """Multiply a length, or several, by sigma, to four digits."""
    if isinstance(choice, tuple):
        return tuple(_scaled(one, sigma) for one in choice)
    return float(f"{choice * sigma:.4g}")
