"""The graph behind a loss: the black boxes in it, where its white box ends, and backwards of `torch.compile`."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.graph import Node

from torch_zerohess.autograd.closed_form import ClosedForm
from torch_zerohess.autograd.marker import Input
from torch_zerohess.autograd.transforms import compiled, made_by

COMPILED = (
    "the loss must be computed outside of torch.compile, got one with a compiled backward, which torch neither keeps "
    "nor differentiates again: do not compile the model, nor the function that calls it"
)


def black_box_inputs(outputs: Tensor) -> list[Tensor]:
    """Return the inputs of the `BlackBox` layers on the way to `outputs`, each tensor once.

    Raises ValueError if there is none, or if one black box depends on another.
    """
    found = {edge_of(one): one for one in _entries(outputs.grad_fn)}
    if not found:
        raise ValueError(
            "mode 'gauss_newton' found no BlackBox layer between inputs and outputs: name the tensors at which the "
            "white box ends in `through` (a compiled layer is neither found nor differentiated twice)"
        )
    nodes = [one.grad_fn for one in found.values()]
    if _entries(*nodes):
        raise ValueError(
            "mode 'gauss_newton' needs black boxes side by side, but one stands behind another: use mode 'exact'"
        )
    if edges_before(*nodes) & found.keys():
        raise ValueError(
            "mode 'gauss_newton' found a black box whose input is computed from the input of another: name in "
            "`through` the tensors that both come from"
        )
    return list(found.values())


def check_through(outputs: Tensor, through: Sequence[Tensor]) -> None:
    """Raise ValueError if the white box of a loss cannot end at these tensors.

    The curvature through a tensor off the path to the loss would be missing. The curvature through a tensor that is
    given twice, or computed from another, would count twice.
    """
    if not through:
        raise ValueError("through must have at least one tensor, got none: leave it out to end at all BlackBox layers")
    path = {edge_of(outputs), *edges_before(outputs.grad_fn)}
    for index, one in enumerate(through):
        if not one.requires_grad or edge_of(one) not in path:
            raise ValueError(
                f"outputs must be computed from every tensor of through, but through[{index}], {list(one.shape)}, is "
                "not on the path to the loss: give the tensors themselves, not copies and not a second forward pass, "
                "and leave out tensors that the loss does not use or that do not require grad"
            )
    check_once(through=through)
    before = edges_before(*(one.grad_fn for one in through)) if len(through) > 1 else set()
    for index, one in enumerate(through):
        if edge_of(one) in before:
            raise ValueError(
                "through must have tensors side by side, but one of them is computed from "
                f"through[{index}], {list(one.shape)}: leave one of the two out"
            )


def check_once(**arguments: Sequence[Tensor]) -> None:
    """Raise ValueError for an argument that has a tensor twice; all tensors require grad."""
    for name, tensors in arguments.items():
        first: dict[tuple[Node, int], int] = {}
        for index, one in enumerate(tensors):
            if (before := first.setdefault(edge_of(one), index)) < index:
                raise ValueError(f"{name} must have every tensor once, but {name}[{index}] is {name}[{before}] again")


def _entries(*nodes: Node | None) -> list[Tensor]:
    """Return the inputs of all black boxes before some nodes, or at them."""
    seen, stack, found = {*nodes}, [*nodes], []
    while stack:
        current = stack.pop()
        if current is None:
            continue
        if made_by(current, Input) or made_by(current, ClosedForm):
            found.append(current.saved_tensors[0])  # type: ignore[attr-defined]
        for following, _ in current.next_functions:
            if following not in seen:
                seen.add(following)
                stack.append(following)
    return found


def edges_before(*nodes: Node | None) -> set[tuple[Node, int]]:
    """Return all gradient edges that can be reached from any of the nodes, (node, number of its output) each."""
    seen: set[tuple[Node, int]] = set()
    stack = [*nodes]
    while stack:
        current = stack.pop()
        for following, number in current.next_functions if current is not None else ():
            if following is not None and (following, number) not in seen:
                seen.add((following, number))
                stack.append(following)
    return seen


def uses_of(leaf: Tensor, outputs: Tensor) -> int:
    """Return how many edges of the graph of outputs lead to a leaf."""
    end = edge_of(leaf)
    nodes = {outputs.grad_fn, *(node for node, _ in edges_before(outputs.grad_fn))}
    return sum(edge == end for node in nodes if node is not None for edge in node.next_functions)


def check_twice(outputs: Sequence[Tensor], ends: Sequence[Tensor]) -> None:
    """Raise RuntimeError if a backward of `torch.compile` is on the way from outputs to one of the ends.

    Derivatives of its result are errors of torch, or zeros where unused tensors are allowed.
    """
    before = {edge_of(one) for one in ends if one.requires_grad}
    for output in outputs:
        nodes = {output.grad_fn, *(node for node, _ in edges_before(output.grad_fn))}
        if any(node and compiled(node) and before & edges_before(node) for node in nodes):
            raise RuntimeError(COMPILED)


def edge_of(tensor: Tensor) -> tuple[Node, int]:
    edge = torch.autograd.graph.get_gradient_edge(tensor)
    return edge.node, edge.output_nr
