"""Methods by name, one module per family."""

from experiments.methods import (
    analytic,
    bayesian,
    derivative_free,
    gauss_newton,
    learned,
    meshes,
    mitsuba,
    paper,
    quasi_newton,
    trust_region,
    turbo,
)
from experiments.methods.method import Method

METHODS: dict[str, Method] = {
    method.name: method
    for family in (
        *(paper, trust_region, gauss_newton, derivative_free, quasi_newton),
        *(bayesian, turbo, learned, analytic, meshes, mitsuba),
    )
    for method in family.METHODS
}

__all__ = ["METHODS", "Method"]
