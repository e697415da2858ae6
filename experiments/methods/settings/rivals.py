"""Settings of the rivals: the methods that a user would pick instead of ours.

Chosen on starts that no table reports (runs from 1000 upward), by the share of runs that reduce the image error by
99 % and then by the median of their evaluations. All of their space (`experiments.methods.settings.spaces`) was tried
on ten starts (four for bfgs_adaptive_fd, forty for analytic_2 on BRDF). Of the quasi-Newton methods on sampled
gradients, eight combinations drawn from their space were tried on four starts, with 8000 evaluations. What is not named
here has the defaults of the method.
"""

from collections.abc import Mapping
from typing import Any


def _sampled(samples: int, start: float, end: float, steps: int, **more: Any) -> dict[str, Any]:
    return {"samples": samples, "start": start, "end": end, "steps": steps, **more}


# ZeroGrads and RELAX, each on three starts. Nine settings were tried on MUG, SHAD, BUNNY, MIRROR and BOX2, and of RELAX
# on BRDF; ZeroGrads on BRDF has had eight. Eight more settings of ZeroGrads were tried on SHAD, three more on BOX2. No
# setting of ZeroGrads gets there on BUNNY and MIRROR, and none of RELAX on MIRROR: these have the settings of MUG.
# tune mug --method zerograds --runs 3 --trials 8; the same for relax and the others; box2, brdf: --evaluations 6000, of
# zerograds on brdf: --evaluations 2000
# tune shad --method zerograds --runs 3 --trials 7 --seed 1 --over pairs=1,2 "sigma=(1.0,0.1),(1.0,0.03)" \
#     steps=100,300 rate=0.05,0.1 fit_rate=0.003,0.01 fits=10,30
_ZEROGRADS = {"pairs": 1, "sigma": (1.0, 0.1), "steps": 300, "rate": 0.2, "fit_rate": 0.01, "fits": 30}
_RELAX = {"samples": 4, "sigma": (1.0, 0.01), "steps": 100, "rate": 0.2, "fit_rate": 0.01, "hidden": (10,)}

# COBYQA, Py-BOBYQA, CMA-ES with bounds, DFO-LS and L-BFGS-B on MUG, SHAD, BUNNY, MIRROR, BOX2, BRDF:
# tune mug --method py_bobyqa --runs 3 --trials 8; the same for the others; box2, brdf: --evaluations 6000
# That is all of their space but for Py-BOBYQA, 8 of 10. What is not named here was best at its defaults.

TUNED: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    # tune bunny --method mitsuba_path --runs 3 --evaluations 120 --over rate=0.3,0.5,1.0; --method mitsuba_projective
    # --evaluations 100 --over rate=0.1,0.2; --method mitsuba --evaluations 120 --over rate=0.3,0.5: default is best.
    # On mug and mirror no rate of mitsuba_path gets there (--runs 2 --evaluations 200 --over rate=0.03,0.3), nor one of
    # mitsuba_projective (--runs 2 --evaluations 100 --over rate=0.1,0.3,1.0 steps=50; on shad the default is best).
    "bunny": {
        "mitsuba_path": {"rate": 0.3},
        "mitsuba_projective": {"rate": 0.2},
        "zerograds": _ZEROGRADS,
        "relax": {"samples": 4, "sigma": (0.5, 0.03), "rate": 0.03, "hidden": (10, 10)},
        "cma_es_bounded": {"scale": 0.25},
        "cobyqa": {"scale": 0.1},
        "dfo_ls": {"scale": 0.5},
    },
    "mug": {
        "zerograds": _ZEROGRADS,
        "relax": _RELAX,
        "cma_es_bounded": {"scale": 0.1},
        "py_bobyqa": {"scale": 0.5},
    },
    "mirror": {"zerograds": _ZEROGRADS, "relax": _RELAX, "cma_es_bounded": {"scale": 0.5}},
    "shad": {
        "cma_es_bounded": {"scale": 2.0},
        "zerograds": {**_ZEROGRADS, "rate": 0.05, "fit_rate": 0.003},
        "relax": {"samples": 2, "rate": 0.03, "fit_rate": 0.03, "hidden": (64,)},
    },
    "quad": {
        "cma_es": {"scale": 0.5},
        "cobyqa": {"scale": 1.0},
        "bfgs_fd": {"difference": 1e-6},
        "lbfgs_fd": {"difference": 1e-6},
        "analytic_1": {"rate": 0.3, "steps": 50},
        "analytic_2": {"radius": 5.0, "steps": 3},
        "bfgs": _sampled(4, 0.5, 0.1, 20, longest=2.0),
        "bfgs_damped": _sampled(4, 0.5, 0.1, 20, longest=2.0),
        "bfgs_wolfe": _sampled(4, 0.5, 0.1, 20, longest=2.0),
        "bfgs_wolfe_frozen": _sampled(8, 1.0, 0.1, 20, longest=2.0),
        "lbfgs": _sampled(8, 1.0, 0.01, 100, inner=5),
        "lbfgs_frozen": _sampled(4, 1.0, 0.1, 20, inner=2),
        "bfgs_adaptive_fd": _sampled(1, 0.1, 0.01, 50),
        "bfgs_adaptive_fd_frozen": _sampled(1, 0.1, 0.01, 50),
    },
    "box2": {
        "zerograds": {
            "pairs": 2,
            "sigma": (0.33, 0.33),
            "steps": 50,
            "rate": 0.1,
            "fit_rate": 0.003,
            "fits": 3,
            "hidden": (32, 32),
        },
        "py_bobyqa": {"scale": 2.0},
        "cma_es": {"scale": 1.0},
        "cma_es_bounded": {"scale": 1.0},
        "cobyqa": {"scale": 1.0},
        "dfo_ls": {"scale": 0.1},
        "bfgs_fd": {"difference": 1e-6},
        "lbfgs_fd": {"difference": 1e-6},
        "bfgs": _sampled(8, 1.0, 0.01, 100, longest=1.0),
        "bfgs_damped": _sampled(8, 1.0, 0.01, 100, longest=1.0),
        "bfgs_frozen": _sampled(8, 1.0, 0.01, 100, longest=1.0),
        "bfgs_damped_frozen": _sampled(8, 1.0, 0.01, 100, longest=1.0),
        "lbfgs": _sampled(4, 1.0, 0.01, 100, inner=10),
        "lbfgs_frozen": _sampled(8, 1.0, 0.1, 20, inner=10),
        "bfgs_adaptive_fd": _sampled(16, 1.0, 0.01, 50),
        "bfgs_adaptive_fd_frozen": _sampled(16, 1.0, 0.01, 50),
    },
    "box10": {"cma_es": {"scale": 1.0}, "cma_es_bounded": {"scale": 1.0}, "dfo_ls": {"scale": 0.1}},
    "brdf": {
        "zerograds": {"pairs": 5, "sigma": (0.33, 0.33), "steps": 100, "rate": 0.1, "fit_rate": 0.01, "fits": 30},
        "relax": {"samples": 8, "sigma": (0.5, 0.03), "steps": 300, "rate": 0.2, "hidden": (10, 10)},
        "cma_es": {"scale": 0.25},
        "cma_es_bounded": {"scale": 0.25},
        "cobyqa": {"scale": 2.0},
        "py_bobyqa": {"scale": 2.0, "seek_global_minimum": False},
        "dfo_ls": {"scale": 2.0},
        "bfgs_fd": {"difference": 0.01},
        "lbfgs_fd": {"difference": 1e-6},
        "analytic_1": {"rate": 0.3, "steps": 50},
        "analytic_2": {"radius": 2.0, "steps": 10},
        "bfgs": _sampled(8, 1.0, 0.1, 20, longest=2.0),
        "bfgs_damped": _sampled(8, 1.0, 0.1, 20, longest=2.0),
        "bfgs_frozen": _sampled(8, 0.5, 0.01, 20, longest=2.0),
        "bfgs_damped_frozen": _sampled(8, 0.5, 0.01, 20, longest=2.0),
        "bfgs_wolfe_frozen": _sampled(8, 0.5, 0.01, 20, longest=2.0),
        "lbfgs": _sampled(4, 1.0, 0.1, 20, inner=2),
        "lbfgs_frozen": _sampled(8, 0.5, 0.01, 20, inner=10),
        "bfgs_adaptive_fd": _sampled(1, 0.1, 0.01, 20),
        "bfgs_adaptive_fd_frozen": _sampled(1, 0.1, 0.01, 50),
    },
    "nonpsd": {
        "cma_es": {"scale": 0.5},
        "cma_es_bounded": {"scale": 0.5},
        "cobyqa": {"scale": 2.0},
        "bfgs_fd": {"difference": 1e-6},
        "lbfgs_fd": {"difference": 1e-6},
        "analytic_1": {"rate": 0.3, "steps": 50},
        "analytic_2": {"radius": 1.0, "steps": 3},
        "bfgs": _sampled(4, 1.0, 0.1, 100, longest=2.0),
        "bfgs_damped": _sampled(4, 1.0, 0.01, 100, longest=2.0),
        "bfgs_frozen": _sampled(2, 0.5, 0.1, 50, longest=1.0),
        "bfgs_damped_frozen": _sampled(4, 1.0, 0.1, 100, longest=2.0),
        "bfgs_wolfe": _sampled(8, 0.5, 0.01, 20, longest=2.0),
        "bfgs_wolfe_frozen": _sampled(2, 0.5, 0.1, 50, longest=1.0),
        "lbfgs": _sampled(4, 1.0, 0.1, 100, inner=10),
        "lbfgs_frozen": _sampled(2, 0.5, 0.1, 50, inner=5),
        "bfgs_adaptive_fd": _sampled(1, 0.1, 0.01, 20),
        "bfgs_adaptive_fd_frozen": _sampled(1, 0.1, 0.01, 50),
    },
}
"""Settings by task and method."""

# BBOB, instances 11 and 12, by the share of targets after 100 n evaluations:
# optimizers --n 2 3 --methods lbfgs_fd --over difference=5e-9,1e-8,1e-6,1e-4,1e-3
# The defaults are best of cma_es_bounded and cobyqa (--n 2 3 --over scale=0.1,0.25,0.5,1) and of py_bobyqa (--n 2
# --over scale=0.1,0.25,0.5,1 seek_global_minimum=True,False).
ON_BBOB: Mapping[str, Mapping[str, Any]] = {"lbfgs_fd": {"difference": 1e-8}}
# More and Wild, every third problem: best of 1e-3, 1e-5 and 1e-7. The other rivals have their defaults.
ON_MORE_WILD: Mapping[str, Mapping[str, Any]] = {"bfgs_fd": {"difference": 1e-7}}
