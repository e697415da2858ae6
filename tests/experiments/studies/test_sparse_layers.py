"""The study of layers behind a network, on a task whose Jacobian is the identity."""

import pytest

from experiments.problems import catalogue
from experiments.studies.sparse_layers import compared


def test_the_truth_and_the_order_of_the_layers():
    rows = compared(catalogue.fitting("texture"), (32,), 1, 0)
    dense, remembering, sparse = rows
    assert [row.layer for row in rows] == ["BlackBox", "BlackBox, Memory", "SparseBlackBox"]
    assert {row.evaluations for row in rows} == {4 * 65}
    assert (sparse.gradient, sparse.product) == (pytest.approx(0.0, abs=1e-3), pytest.approx(0.0, abs=1e-3))
    for row in (dense, remembering):  # it has seen nothing yet
        assert row.gradient > 0.5
        assert row.product > 5.0
