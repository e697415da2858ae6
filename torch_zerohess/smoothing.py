"""Settings of the Gaussian smoothing: the one object that says how a black box is sampled."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer, checked_seed, checked_sigma
from torch_zerohess.choice import chosen_baseline, chosen_sampler, chosen_signs, scrambles_of

Proposal = Literal["aggregate", "gaussian", "optimal", "uniform", "fr22", "auto"]
Baseline = Literal["center", "mean", "none", "auto"]
Sampler = Literal["random", "sobol", "orthogonal", "auto"]
Signs = bool | Literal["auto"]
_CHOSEN = ("proposal", "sampler", "baseline", "antithetic")  # what may be "auto"
_STRIDE = 0x9E3779B97F4A7C15  # between seeds: generators of near seeds begin alike
_SHOWN = 2048  # parameters up to which a repr says what was chosen; beyond the choice stays as it is


class _Sigma:
    """The setting sigma, checked. A reader gets a copy of a tensor, which may be written to."""

    def __get__(self, owner: "Smoothing | None", kind: type) -> Any:
        if owner is None:
            raise AttributeError("sigma has no default")
        sigma = vars(owner)["sigma"]
        return sigma if isinstance(sigma, float) else sigma.clone()

    def __set__(self, owner: "Smoothing", sigma: Any) -> None:
        vars(owner)["sigma"] = checked_sigma(sigma)


@dataclass(frozen=True, kw_only=True, eq=False)
class Smoothing:
    """How a function is convolved with a Gaussian, F(x) = E f(x + sigma u), u ~ N(0, I), and sampled.

    `Smoothing.auto(sigma=...)` is what we recommend: proposal, sampler, baseline and antithetic are then "auto". They
    are chosen for the least error by the number of parameters, the number of evaluations and the order, see `choice`.
    The repr lists the choice for every range of n parameters, and `resolved(n)` returns the chosen settings.

    Args:
        sigma: standard deviation of the Gaussian, in units of x: a positive number, or a tensor [n] of them, one per
            parameter. Features narrower than sigma are blurred away; plateaus up to a few sigma wide get a slope.
        samples: number of perturbations. With `antithetic` each is used with both signs: 2 * samples evaluations.
            With antithetic="auto" there are 2 * samples evaluations too, in pairs or all different.
        proposal: density the perturbations are drawn from.
            "aggregate" mixes the lobes of the kernel's first and second derivative over all dimensions with a Gaussian
            share and divides by the density of that mixture; "gaussian" is the plain normal; "uniform" a box of +-5
            sigma, for comparison, with a warning for fewer than 2.82^n samples of n > 3 parameters; "optimal" one
            sample set per element of gradient and Hessian, with constant weights (samples is then per element); "fr22"
            all dimensions from the signed first-derivative lobe, first order only, a baseline of the literature
            (Fischer and Ritschel 2023). Its gradient is biased for n > 1, and its smoothed value for every n: in one
            dimension the smoothed value of x^2 is x^2 + 2 sigma^2 instead of x^2 + sigma^2.
        antithetic: use every perturbation with both signs.
        baseline: subtracted from f. "center" is f(x); "mean" the mean of all other draws; "none" nothing. "mean" and
            "none" do not need f(x); it is evaluated beside them if value="center". The baseline changes the variance,
            by orders of magnitude, and not the expectation. With sampler "sobol" the draws are scrambles, and samples
            must be even for "mean".
        sampler: "random" independent draws; "sobol" scrambled Sobol points; "orthogonal" blocks of orthogonal
            normal directions, n in each, or fewer where this would not make two blocks (three for baseline "mean").
            What is left over makes the last block longer: more than n directions cover all parameters evenly, too.
            Proposals "uniform" and "fr22" get the quantiles of their own distribution that belong to these directions.
            Lobes of the other proposals are drawn independently.
        seed: None draws a new seed from torch's default generator at every call. A number below 2^63 freezes the
            perturbations: every call uses the same ones, whatever the number of threads. With a `Memory`, and with an
            earlier `SparseJacobian`, they also depend on the number of evaluations that it has taken. Layers in
            sequence must not share a seed, nor may a layer with a seed get its own output: gradients are biased,
            because the sampled Jacobians depend on each other. Give each layer another seed, or seed=None after
            `torch.manual_seed`.
        scrambles: independent scrambles of sampler "sobol", a divisor of samples. Fewer ones have a smaller error, and
            a standard error with fewer degrees of freedom. None: the largest of 1, 2, 4 and 8 that divides samples; 4
            and 8 only with at least 8 points in each scramble, 8 only if no setting is "auto".
        order: highest derivative that is wanted; 1 leaves out the lobes made for the second. Second derivatives stay
            available from "aggregate", with more variance, and not from "optimal".

    Raises:
        ValueError, TypeError: a setting is out of its range; the message names it.

    Example:
        >>> Smoothing(sigma=0.1, samples=4).evaluations(n=3)
        9
        >>> smoothing = Smoothing.auto(sigma=0.1, samples=16, order=1)
        >>> smoothing.resolved(n=10).sampler, smoothing.evaluations(n=10)
        ('orthogonal', 33)
    """

    sigma: float | Tensor = _Sigma()  # type: ignore[assignment]
    samples: int = 8
    proposal: Proposal = "aggregate"
    antithetic: Signs = True
    baseline: Baseline = "center"
    sampler: Sampler = "random"
    seed: int | None = None
    order: int = 2
    scrambles: int | None = None

    def __post_init__(self) -> None:
        for name, least in (("samples", 1), ("order", 1), ("scrambles", 1)):
            number = getattr(self, name)
            if number is not None or name in ("samples", "order"):  # as integers of Python, for `state_dict`
                object.__setattr__(self, name, checked_integer(name, number, least))
        if self.order > 2:
            raise ValueError(f"order must be 1 or 2, got {self.order}")
        if self.seed is not None:
            object.__setattr__(self, "seed", checked_seed(self.seed))
        for name, value, allowed in (
            ("proposal", self.proposal, get_args(Proposal)),
            ("baseline", self.baseline, get_args(Baseline)),
            ("sampler", self.sampler, get_args(Sampler)),
            ("antithetic", self.antithetic, (True, False, "auto")),
        ):
            if value not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}")
        if self.antithetic != "auto":
            object.__setattr__(self, "antithetic", bool(self.antithetic))
        if self.scrambles is not None and self.samples % self.scrambles:
            raise ValueError(f"scrambles must divide samples, got {self.scrambles} of {self.samples}")
        if self.scrambles is not None and self.sampler != "sobol":
            raise ValueError(f"scrambles need sampler 'sobol', got {self.scrambles} with sampler {self.sampler!r}")
        if self.baseline == "mean" and self.proposal != "optimal":
            self._check_draws()

    def _check_draws(self) -> None:
        """Raise ValueError if all samples are one independent draw: there are no other draws to take the mean of."""
        # n = 1 has the most draws: a setting that passes here may still be refused by a call with more parameters.
        choice = self._choice(1)
        sobol = choice["sampler"] == "sobol"
        if (choice["scrambles"] if sobol else choice["samples"]) > 1:
            return
        if sobol:
            raise ValueError(
                "baseline 'mean' needs the mean of other draws, which are scrambles with sampler 'sobol': samples must "
                f"be even, and scrambles None or at least 2, got samples={self.samples}, scrambles={self.scrambles}"
            )
        raise ValueError(
            f"baseline 'mean' needs the mean of other draws: samples must be at least 2, got {self.samples}"
        )

    def __eq__(self, other: object) -> bool:
        """Whether all settings are the same."""
        return isinstance(other, Smoothing) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[Any, ...]:
        """Every setting, as numbers and texts."""
        settings = (getattr(self, one.name) for one in fields(self))
        return tuple(tuple(one.tolist()) if isinstance(one, Tensor) else one for one in settings)

    @classmethod
    def auto(cls, *, sigma: float | Tensor, **settings: Any) -> "Smoothing":
        """Return settings that are "auto" where nothing else is given."""
        return cls(sigma=sigma, **{**dict.fromkeys(_CHOSEN, "auto"), **settings})

    def replace(self, **changes: Any) -> "Smoothing":
        """Return a copy with some settings changed, validated again."""
        unknown = sorted(set(changes) - {field.name for field in fields(self)})
        if unknown:
            raise TypeError(f"Smoothing has no setting {', '.join(map(repr, unknown))}")
        return replace(self, **changes)

    def evaluations(self, n: int, *, center: bool = True) -> int:
        """Black-box evaluations of one estimate at a point of n parameters, f(x) included where `center` is true."""
        rows = self.samples * self.groups(n) * (2 if self.antithetic else 1)
        return rows + center

    def groups(self, n: int) -> int:
        """Number of sample sets: one, or for "optimal" one for the value and one for every element."""
        if self.proposal != "optimal":
            return 1
        return 1 + n + (n * (n + 1) // 2 if self.order == 2 else 0)

    def resolved(self, n: int) -> "Smoothing":
        """Return the settings for x of n parameters, without "auto" in them; itself if there is none."""
        if not self._automatic:
            return self
        if n not in self._resolved:
            self._resolved[n] = replace(self, **self._choice(n))
        return self._resolved[n]

    @cached_property
    def _automatic(self) -> bool:
        return any(getattr(self, name) == "auto" for name in _CHOSEN)

    @cached_property
    def _resolved(self) -> dict[int, "Smoothing"]:
        return {}

    def _choice(self, n: int) -> dict[str, Any]:
        """Return what differs for x of n parameters."""
        proposal, sampler, signs, baseline = self.proposal, self.sampler, self.antithetic, self.baseline
        evaluations = self.samples * (2 if self.antithetic else 1)
        mixed = proposal in ("aggregate", "gaussian", "auto")
        if sampler == "auto":
            sampler = chosen_sampler(n, evaluations, self.order) if mixed else "random"
        if signs == "auto":
            signs = chosen_signs(n, evaluations, self.order, sampler) if mixed else True
        samples = self.samples if signs or self.antithetic is False else evaluations
        if sampler == "sobol" and self.sampler == "auto" and samples % 2:  # one scramble has no standard error
            sampler = "orthogonal"
        scrambles = scrambles_of(samples) if sampler == "sobol" and self.scrambles is None else self.scrambles
        if proposal == "auto":
            proposal = "gaussian" if self.order == 1 and sampler == "orthogonal" else "aggregate"
        if baseline == "auto":
            draws = scrambles if sampler == "sobol" and scrambles else samples
            baseline = chosen_baseline(signs, draws, samples // draws) if mixed else "center"
        chosen = {"proposal": proposal, "sampler": sampler, "antithetic": signs, "baseline": baseline}
        return {**chosen, "samples": samples, "scrambles": scrambles}

    def __repr__(self) -> str:
        settings = ", ".join(f"{field.name}={getattr(self, field.name)!r}" for field in fields(self))
        if not self._automatic:
            return f"Smoothing({settings})"
        return f"Smoothing({settings}; auto: {'; '.join(self._chosen_ranges())})"

    @property
    def paired(self) -> bool:
        """Whether perturbations are used with both signs, in settings without "auto"."""
        return bool(self.antithetic)

    @property
    def sampling(self) -> str:
        """How points are sampled, as text."""
        return _sampling(self.proposal, self.sampler, self.antithetic, self.baseline)

    def _chosen_ranges(self) -> list[str]:
        """Return the choice for every range of numbers of parameters, as text."""
        ranges: list[tuple[int, str]] = []
        for n in range(1, _SHOWN + 1):
            text = _sampling(**self._choice(n))
            if ranges and ranges[-1][1] == text:
                ranges.pop()
            ranges.append((n, text))
        return [f"{text} up to n = {last}" for last, text in ranges[:-1]] + [
            ranges[-1][1] + (" beyond" if ranges[1:] else "")
        ]

    def drawn_seed(self, taken: int = 0) -> int:
        """Return the seed of a call; from torch's global generator if `seed` is None.

        taken: evaluations that a memory, or an earlier sparse Jacobian, has taken before the call.
        """
        if self.seed is None:
            return random_seed()
        return following_seed(self.seed, taken)

    def sigma_vector(self, n: int, device: torch.device) -> Tensor:
        """Return sigma as float64 [n]; ValueError for a tensor that has not n elements."""
        sigma = vars(self)["sigma"]
        if isinstance(sigma, float):
            return torch.full((n,), sigma, dtype=torch.float64, device=device)
        if len(sigma) != n:
            raise ValueError(f"sigma has {len(sigma)} elements, but x has {n} parameters: give one number or {n}")
        return sigma.to(device=device, dtype=torch.float64)


def settings_of(smoothing: Smoothing) -> dict[str, Any]:
    """Return all settings by name, for a state_dict."""
    return {one.name: getattr(smoothing, one.name) for one in fields(Smoothing)}


def smoothing_of(settings: Mapping[str, Any], what: str) -> Smoothing:
    """Return the smoothing that `settings_of` described, in the state of `what`; KeyError for a name of no setting."""
    if unknown := settings.keys() - {one.name for one in fields(Smoothing)}:
        raise KeyError(f"state must be a state_dict of {what}, this one has {', '.join(sorted(map(str, unknown)))}")
    if "sigma" not in settings:
        raise KeyError(f"state must be a state_dict of {what}, this one lacks sigma")
    return Smoothing(**settings)


def check_smoothing(value: Any) -> None:
    """Raise TypeError for what is no `Smoothing`."""
    if not isinstance(value, Smoothing):
        raise TypeError(f"smoothing must be a Smoothing, got {type(value).__name__}")


def random_seed() -> int:
    """Return a seed that torch's generator of the CPU draws."""
    return int(torch.randint(2**63 - 1, (), device="cpu"))


def following_seed(seed: int, number: int) -> int:
    """Return one of the seeds that follow from a seed, by its number; number 0 is the seed itself."""
    return (seed + _STRIDE * number) % 2**63


def _sampling(proposal: str, sampler: str, antithetic: Signs, baseline: str, **_: Any) -> str:
    return f"{proposal}, {sampler}, {'pairs' if antithetic else 'single'}, {baseline}"
