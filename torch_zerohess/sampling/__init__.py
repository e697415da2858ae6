"""Bits: where perturbations come from, their densities and their weights."""
