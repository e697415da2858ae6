"""Methods by name, one module per family."""

from experiments.methods import (
    analytic,
    bayesian,
    derivative_free,
    gauss_newton,
    learned,
    memory_networks,
    mesh_handles,
    mesh_levels,
    mitsuba,
    ours,
    paper,
    quasi_newton,
    rendered_pairs,
    turbo,
)
from experiments.methods.method import Method

METHODS: dict[str, Method] = {
    method.name: method
    for family in (
        *(paper, ours, memory_networks, rendered_pairs, gauss_newton, derivative_free, quasi_newton),
        *(bayesian, turbo, learned, analytic, mesh_handles, mesh_levels, mitsuba),
    )
    for method in family.METHODS
}

__all__ = ["METHODS", "Method"]
