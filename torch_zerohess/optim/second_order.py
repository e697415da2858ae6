"""Shared by the second-order optimizers: one group of parameters as a vector, and the quadratic model of a loss."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from torch_zerohess.arguments import check_bool, check_state, checked_number
from torch_zerohess.autograd.blocks import jacobian as white_box_jacobian
from torch_zerohess.autograd.blocks import output_blocks
from torch_zerohess.autograd.curvature import CurvatureOperator
from torch_zerohess.autograd.sample_jacobian import SampleJacobian
from torch_zerohess.linalg.dual import dual_step
from torch_zerohess.linalg.flat import add_parts, flattened, overwrite, split_like
from torch_zerohess.linalg.jacobians import Jacobian, Rows
from torch_zerohess.linalg.magnitudes import magnitudes
from torch_zerohess.linalg.step import Step
from torch_zerohess.optim import dual_system, processes
from torch_zerohess.optim.dual_system import DualSystem
from torch_zerohess.optim.outside import check_inside

Loss = Tensor | tuple[Tensor, Tensor | Sequence[Tensor]] | tuple[Tensor, Tensor | Sequence[Tensor], SampleJacobian]
"""What a closure returns: loss, (loss, y), or (loss, y, jacobian), with the inputs y of the black boxes."""
Closure = Callable[[], Loss]
CURVATURES = ("exact", "gauss_newton")
_INDEFINITE = 100.0
"""Negative eigenvalue of a curvature that is more than rounding, over the largest magnitude times the rounding."""
CALLS_BACKWARD = "closure must return the loss without calling backward: the step itself takes the derivatives"
"""What is wrong with a closure as for the optimizers of torch."""
TRIALS = 10
"""Evaluations of one step at most; it is shortened after each one at which the loss is not finite."""


class Model:
    """Loss, gradient and Hessian at one point, N parameters; R estimates of them where R losses were given.

    The curvature is taken from the graph of the loss, so that all products use the samples of one forward pass. With
    `distributed` all is the mean over the processes, of which each calls the same methods.
    """

    def __init__(
        self,
        losses: Tensor,
        operators: Sequence[CurvatureOperator],
        modification: str | None = None,
        jacobian: SampleJacobian | None = None,
        distributed: bool = False,
    ) -> None:
        self._distributed = distributed
        self.loss = self._mean(losses.detach().mean().to(operators[0].device))
        """[], the mean of the losses."""
        self.gradients = self._mean(torch.stack([one.gradient for one in operators]).double())
        """[R, N], float64"""
        self._operators, self._jacobian = operators, jacobian
        self._blocks = None if modification is None else [self._modified(one) for one in operators]

    def _mean(self, x: Tensor) -> Tensor:
        return processes.mean(x) if self._distributed else x

    @staticmethod
    def _modified(operator: CurvatureOperator) -> list[Tensor]:
        return [magnitudes(block) for block in output_blocks(operator)]

    @property
    def gradient(self) -> Tensor:
        """Their mean, [N]."""
        return self.gradients.mean(0)

    @property
    def finite(self) -> bool:
        """Whether loss and gradient are finite."""
        return bool(torch.isfinite(self.loss)) and bool(torch.isfinite(self.gradients).all())

    def products(self, v: Tensor) -> Tensor:
        """Return the Hessians times v [N]: [R, N], float64."""
        length = v.norm()  # of a unit vector, so that float32 parameters neither over- nor underflow
        if not float(length) > 0.0:
            return torch.zeros_like(self.gradients)
        unit = v / length
        if self._blocks is None:
            return self._mean(torch.stack([one @ unit for one in self._operators]).double()) * length
        pairs = zip(self._operators, self._blocks, strict=True)
        return self._mean(torch.stack([self._through(operator, blocks, unit) for operator, blocks in pairs])) * length

    @staticmethod
    def _through(operator: CurvatureOperator, blocks: Sequence[Tensor], v: Tensor) -> Tensor:
        """J^T A J v with modified blocks of A."""
        moved = operator.output_step(v)
        pushed = [
            (block @ one.reshape(len(block), -1, 1).double()).reshape_as(one).to(one)
            for block, one in zip(blocks, moved, strict=True)
        ]
        return operator.pull(pushed).double()

    def dual_step(self, radius: float, damping: float) -> Step | None:
        """Return the step of `linalg.dual.dual_step` for the mean of the losses; None where A is indefinite."""
        all_of = dual_system.joined(self._system, self.loss.device) if self._distributed else self._system()
        if self._blocks is None:
            values = torch.linalg.eigvalsh(all_of.A)
            if float(values[0]) < -_INDEFINITE * torch.finfo(self.loss.dtype).eps * float(values.abs().max()):
                return None
        return (dual_system.same_step if self._distributed else dual_step)(*all_of, radius, damping)

    def _system(self) -> DualSystem:
        """The system of this process."""
        A = torch.stack([torch.block_diag(*self._dense(index)) for index in range(len(self._operators))]).mean(0)
        J, sampled = self._white_box, self._jacobian is not None
        gradient = torch.stack([one.gradient for one in self._operators]).double().mean(0)
        return DualSystem(J, A, check_inside(J, self._operators, gradient, sampled=sampled))

    @cached_property
    def _white_box(self) -> Jacobian:
        """J of all outputs of the white box."""
        operator = self._operators[0]
        if self._jacobian is None:
            return Rows(white_box_jacobian(operator))
        J, numbers = self._jacobian.products(operator.inputs), sum(one.numel() for one in operator.through)
        if J.outputs != numbers:
            raise ValueError(
                f"SampleJacobian must have the inputs of the same batch: its Jacobian has {J.outputs} rows "
                f"({len(self._jacobian.inputs)} samples), and y has {numbers} numbers"
            )
        return J

    def longest_move(self, s: Tensor) -> float:
        """Return how far a step s [N] moves the input [n] of a black box, for the element that moves farthest."""
        operator = self._operators[0]
        if self._jacobian is None:
            moved = operator.output_step(s)
        else:
            moved = split_like(self._white_box.matvec(s), operator.through)
        longest = torch.stack([one.norm(dim=-1).max().double() for one in moved]).max()
        return float(processes.largest(longest) if self._distributed else longest)

    def _dense(self, index: int) -> list[Tensor]:
        """Blocks [n, n] of one operator, modified if they are to be."""
        blocks = output_blocks(self._operators[index]) if self._blocks is None else self._blocks[index]
        return [one for block in blocks for one in block]

    def hessian(self) -> Tensor:
        """Return the mean Hessian [N, N], float64 and symmetric."""
        dense = self._mean(torch.stack([one.to_dense() for one in self._operators]).double().mean(0))
        return 0.5 * (dense + dense.mT)


_ROUNDING = 1e-9
"""How far a learning rate may be out of its range."""


def checked_lr(group: dict[str, Any]) -> float:
    """Return the learning rate of a group, which a scheduler may have set; ValueError if it is not in [0, 1].

    Schedulers that end at 0 or 1 may end a little beyond it, by rounding. That counts as 0 or 1.
    """
    lr = group["lr"]
    if isinstance(lr, float) and -_ROUNDING < lr < 1.0 + _ROUNDING:
        return float(min(max(lr, 0.0), 1.0))
    return checked_number("lr", lr, 0.0, most=1.0)


class SecondOrder(Optimizer):
    """An optimizer with one Hessian, hence one group of parameters.

    With `distributed` a step uses the mean over all processes of `torch.distributed`, of loss, gradient and curvature.
    All of them make it, from equal parameters. It is no setting of a group: a state may go on in another number of
    processes.
    """

    _distributed = False

    def __init__(self, params: Iterable[Tensor], defaults: dict[str, Any], *, distributed: bool = False) -> None:
        check_bool(distributed=distributed)
        if distributed:
            processes.check_started()
        self._distributed = bool(distributed)
        defaults["lr"] = checked_lr(defaults)
        if defaults["curvature"] not in CURVATURES:
            raise ValueError(f"curvature must be 'exact' or 'gauss_newton', got {defaults['curvature']!r}")
        super().__init__(params, defaults)
        if not self._parameters:
            raise ValueError("params must have a parameter that requires grad, got none")
        for one in self._parameters:
            if one.is_complex():
                raise TypeError(f"params must be real, got {one.dtype}: optimize torch.view_as_real of a parameter")
        if not any(one.numel() for one in self._parameters):
            raise ValueError("params must have at least one number, got empty tensors")

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Refuse a second group of parameters, because the quadratic model has one Hessian, and settings in a group."""
        if self.param_groups:
            raise ValueError(
                "params must be one group, as for torch.optim.LBFGS, because the quadratic model has one Hessian: give "
                "all parameters in one list"
            )
        if own := param_group.keys() - {"params", "param_names"}:
            advice = f"give them to {type(self).__name__}"
            if "weight_decay" in own:
                advice = "for a weight decay w add w / 2 * sum(p.square().sum() for p in params) to the loss"
            raise ValueError(f"params must have no settings of their own, got {', '.join(sorted(own))}: {advice}")
        super().add_param_group(param_group)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has: that of torch, and whether it is distributed."""
        return super().__getstate__() | {"_distributed": self._distributed}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take a loaded state, after all hooks. KeyError if it lacks a setting: it is of another optimizer."""
        for group in state["param_groups"]:
            check_state(group, getattr(self, "defaults", {}), type(self).__name__)
        super().__setstate__(state)

    @property
    def _output_modification(self) -> str | None:
        """How the curvature over the outputs of the white box is modified, see `Model`."""
        return None

    @property
    def _parameters(self) -> list[Tensor]:
        """Parameters that require grad."""
        return [one for one in self.param_groups[0]["params"] if one.requires_grad]

    def _model(self, closure: Closure, *, separate: bool = False) -> Model:
        """Evaluate the closure where the parameters are; `separate` keeps the estimates of several losses apart."""
        curvature = self.param_groups[0]["curvature"]
        if torch.is_inference_mode_enabled():
            raise RuntimeError("a step needs derivatives of the loss, which inference mode forbids: use torch.no_grad")
        torch.clear_autocast_cache()  # torch 2.10 also keeps copies that the last step has made without a graph
        with torch.enable_grad():
            if not callable(closure):
                raise TypeError(f"closure must be callable, a function that returns the loss, got {closure!r}")
            with nullcontext() if self._distributed else processes.refused(self._parameters):
                losses, through, jacobian = parts_of(closure())
            if not losses.requires_grad:
                raise ValueError(
                    "closure must return a loss with a graph, got one without: no parameter is in it, or it was "
                    "detached, as by a training loop that calls backward itself; in Lightning set "
                    "automatic_optimization=False, and give step a closure of your own"
                )
            parts = list(losses.reshape(-1).unbind()) if separate else [losses.mean()]
            try:
                of_parts = [CurvatureOperator(one, self._parameters, mode=curvature, through=through) for one in parts]
            except RuntimeError as error:
                if "backward through the graph a second time" in str(error):
                    raise RuntimeError(CALLS_BACKWARD) from error
                raise
            if not any(one.depends for one in of_parts):
                raise ValueError(
                    "closure must return a loss that depends on params, got one with a graph in which none of them is: "
                    "give the optimizer the parameters of the network that the closure calls"
                )
            if self._distributed:
                processes.check_equal(self._parameters, len(parts))
            return Model(losses, of_parts, self._output_modification, jacobian, self._distributed)

    def _add(self, step: Tensor) -> None:
        """Add step [N] to the parameters."""
        add_parts(self._parameters, step)

    def _copy(self) -> list[Tensor]:
        """Return a copy of the parameters, to `_restore`."""
        return [one.detach().clone() for one in self._parameters]

    def _restore(self, place: list[Tensor]) -> None:
        """Put the parameters back, to the last bit."""
        overwrite(self._parameters, place)

    def _get(self, name: str) -> Tensor | None:
        """Return a vector of the state, [N] float64, or None where a parameter has none."""
        parts = [self.state.get(one, {}).get(name) for one in self._parameters]
        if any(part is None for part in parts):
            return None
        return flattened(parts).double()

    def _set(self, name: str, vector: Tensor) -> None:
        """Keep a vector [N] in the state, in the types of the parameters."""
        for one, part in zip(self._parameters, split_like(vector, self._parameters), strict=True):
            self.state[one][name] = part.to(one.dtype)

    def _forget(self, name: str) -> None:
        """Remove a vector from the state."""
        for one in self._parameters:
            self.state.get(one, {}).pop(name, None)


def parts_of(result: Loss) -> tuple[Tensor, Tensor | Sequence[Tensor] | None, SampleJacobian | None]:
    """Return the loss, the tensors at which the white box ends, and their Jacobian, as far as the closure gave them."""
    loss, through, jacobian = (*result, None, None)[:3] if isinstance(result, tuple) else (result, None, None)
    if not isinstance(loss, Tensor) or loss.numel() == 0:
        raise TypeError(f"closure must return the loss, a tensor with a graph, got {loss!r}")
    if jacobian is not None and not isinstance(jacobian, SampleJacobian):
        raise TypeError(f"closure must return a SampleJacobian after the loss and y, got {type(jacobian).__name__}")
    return loss, through, jacobian
