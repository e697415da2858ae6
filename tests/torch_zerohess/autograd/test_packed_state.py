"""The state of a layer is one tensor of bytes: what it holds, and what loads it."""

import io
from collections import OrderedDict

import pytest
import torch
from torch import nn

import torch_zerohess as zh
from torch_zerohess.autograd.packed_state import packed, unpacked
from torch_zerohess.smoothing import settings_of


def layer(*, memory: bool = False, sigma: float = 0.3, **settings) -> zh.BlackBox:
    kept = zh.Memory(**settings) if memory else None
    return zh.BlackBox(lambda z: z, zh.Smoothing(sigma=sigma), head=zh.heads.SquaredError(), memory=kept)


def filled() -> zh.BlackBox:
    one, z = layer(memory=True, sigma=0.7), torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    one.memory.add(z, z.square())
    return one


@pytest.mark.parametrize(
    "module",
    [layer(), layer(memory=True), filled(), zh.SparseBlackBox(lambda z: z, zh.Smoothing(sigma=0.1, samples=8))],
)
def test_files_of_tensors_alone_hold_a_model(module: nn.Module) -> None:
    state = nn.Sequential(nn.Linear(2, 3), module).state_dict()
    assert {type(one) for one in state.values()} == {torch.Tensor}
    assert state["1._extra_state"].dtype == torch.uint8


def test_the_state_has_everything() -> None:
    first, second = filled(), layer(memory=True)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True))
    assert second.smoothing == first.smoothing
    assert torch.equal(second.memory.points, first.memory.points)
    assert torch.equal(second.memory.outputs, first.memory.outputs)


def test_states_of_layers_without_a_memory_have_one_length() -> None:
    """What loads numbers in place, as torch.distributed.checkpoint does, needs equal shapes."""
    several = [
        {"sigma": 0.1},
        {"sigma": torch.linspace(0.1, 1.0, 9), "samples": 100_000, "proposal": "gaussian", "seed": 2**62},
    ]
    lengths = {packed(settings_of(zh.Smoothing(**settings))).shape for settings in several}
    assert lengths == {(4096,)}


@pytest.mark.parametrize("size", [0, 1, 4000, 5000])
def test_what_was_packed_is_returned(size: int) -> None:
    state = {"numbers": torch.arange(size), "nothing": None, "text": "a", "moments": [[1.5, 2], []]}
    found = unpacked(packed(state))
    assert torch.equal(found.pop("numbers"), state.pop("numbers"))
    assert found == state


def test_the_tensors_are_where_the_bytes_are() -> None:
    state = packed({"numbers": torch.arange(3)})
    assert unpacked(state)["numbers"].device == state.device
    assert packed({"numbers": torch.arange(3)}, "meta").device.type == "meta"


@pytest.mark.parametrize(
    "wrong",
    [
        packed({"numbers": torch.arange(1000)})[:5000],  # its length is that of the whole
        packed({}).half(),  # as by a conversion of all tensors of a file
        packed({})[None],
        torch.zeros(4, dtype=torch.uint8),
        torch.zeros(4096, dtype=torch.uint8),
    ],
)
def test_a_tensor_that_is_no_state_is_refused(wrong: torch.Tensor) -> None:
    """Nothing beyond its end is read."""
    with pytest.raises(
        ValueError, match=r"must be the tensor of bytes that its state_dict has, uint8 and not cut, got"
    ):
        layer().load_state_dict({"_extra_state": wrong})


def test_a_state_that_is_a_dictionary_is_taken_too() -> None:
    one = layer()
    one.load_state_dict(OrderedDict(_extra_state=settings_of(zh.Smoothing(sigma=0.7))))
    assert one.smoothing.sigma == 0.7


def test_a_layer_without_a_memory_leaves_evaluations_out_if_it_need_not_be_strict() -> None:
    state = nn.Sequential(filled()).state_dict()
    one = nn.Sequential(layer())
    with pytest.raises(RuntimeError, match=r"0\._extra_state with a memory: make the layer with memory=Memory\(\)"):
        one.load_state_dict(state)
    with pytest.raises(ValueError, match="the state has a memory, but the layer has none"):
        one[0].set_extra_state(filled().get_extra_state())
    one.load_state_dict(state, strict=False)
    assert one[0].smoothing.sigma == 0.7
    other = nn.Sequential(layer(memory=True))
    other.load_state_dict(state, strict=False)
    assert len(other[0].memory) == 20


def test_a_memory_may_stay_out_of_the_state_of_its_layer() -> None:
    one = filled()
    one.memory.persistent = False
    assert one.state_dict()["_extra_state"].shape == (4096,)
    layer().load_state_dict(one.state_dict())
    assert len(one.memory.state_dict()["points"]) == 20
    with pytest.raises(TypeError, match="persistent must be True or False, got 'no'"):
        zh.Memory(persistent="no")
