"""Every law is unbiased for the function that it smooths, and has the covariance that it says."""

import math

import pytest
import torch

from experiments.studies.smoothing_laws import HEADERS, LAWS, PROFILES, Law, row_of, smoothing_laws

NAMES = [one.name for one in LAWS]


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
@pytest.mark.parametrize("n", [1, 5])
def test_marginals_are_densities_of_the_covariance(law: Law, n: int) -> None:
    t = torch.linspace(-3000.0, 3000.0, 600_001, dtype=torch.float64)
    density = law.marginal(t, n)
    assert float(torch.trapezoid(density, t)) == pytest.approx(1.0, abs=0.003)
    # The tail of nu = 3 beyond 3 000 has a share of 0.0004, and the ends of the ball are within 0.01.
    assert float(torch.trapezoid(density * t * t, t)) == pytest.approx(law.width**2, rel=0.01)
    u = law.draw((2, 50_000, n), torch.Generator().manual_seed(1))
    if law.ball:
        assert u.square().sum(2).sqrt().sub(math.sqrt(n + 2)).abs().max() < 1e-12
    else:
        inside = float((u[..., 0].abs() < law.width).double().mean())
        expected = float(torch.trapezoid(density[t.abs() < law.width], t[t.abs() < law.width]))
        assert inside == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
@pytest.mark.parametrize("profile", PROFILES[:2], ids=["wave", "step"])
def test_many_evaluations_tell_the_derivatives(law: Law, profile) -> None:
    """64 evaluations have errors of up to 0.7 and 1, and 256 times as many a sixteenth of them."""
    row = dict(zip(HEADERS, row_of(law, 2, profile, 2**14, 20, 0), strict=True))
    assert row["gradient"] < 0.06
    assert row["Hessian"] < 0.09 if not law.ball else row["Hessian"] is None


def test_where_a_ball_does_not_reach_nothing_is_said() -> None:
    rows = [dict(zip(HEADERS, row, strict=True)) for row in smoothing_laws(sizes=(2,), evaluations=4, runs=3)]
    assert len(rows) == len(LAWS) * len(PROFILES)
    assert [row["gradient"] is None for row in rows] == [
        (row["law"], row["function"]) == ("ball", "far step") for row in rows
    ]
    assert {row["bias"] for row in rows if row["function"] == "bowl"} == {0.0}


@pytest.mark.parametrize("wrong", [{"sizes": ()}, {"sizes": (0,)}, {"evaluations": 5}, {"runs": 1}])
def test_settings_out_of_range(wrong) -> None:
    with pytest.raises(SystemExit, match="must be"):
        smoothing_laws(**wrong)
