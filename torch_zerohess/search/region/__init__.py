"""Quadratics in a trust region, for a loss or an output."""
