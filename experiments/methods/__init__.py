"""Methods by name, one module per family."""

import importlib
import importlib.util

from experiments.methods.method import Method

_FAMILIES = ("paper", "trust_region", "derivative_free", "quasi_newton", "analytic")

METHODS: dict[str, Method] = {
    method.name: method
    for family in _FAMILIES
    if importlib.util.find_spec(f"experiments.methods.{family}")
    for method in importlib.import_module(f"experiments.methods.{family}").METHODS
}

__all__ = ["METHODS", "Method"]
