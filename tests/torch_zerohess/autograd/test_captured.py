"""Tensors that a black box captures get no derivative: a layer warns of those whose derivatives are wanted."""

import functools

import pytest
import torch

import torch_zerohess as zh

SMOOTHING = zh.Smoothing(sigma=0.1, samples=4, seed=0)
GLOBAL = torch.ones(1, requires_grad=True)
SETTING = torch.ones(1)


def scaled(w, z):
    return (w * z).sum(1)


def of_global(z):
    return scaled(GLOBAL, z)


def of_setting(z):
    GLOBAL = z.square()
    return scaled(SETTING, GLOBAL)


class Compiled:
    """A function of a compiler, as of Numba: it keeps the code of what it was made of, and nothing around it."""

    __code__ = of_global.__code__

    def __call__(self, z):
        return z.sum(1)


class Model:
    weight = torch.ones(1, requires_grad=True)

    def of_attribute(self, z):  # what an object keeps is not looked for
        return scaled(self.weight.detach(), z)


def closed(w):
    return lambda z: scaled(w, z)


def leaf():
    return torch.ones(1, requires_grad=True)


@pytest.mark.parametrize(
    ("fn", "name"),
    [
        (lambda: closed(leaf()), "'w'"),
        (lambda: of_global, "'GLOBAL'"),
        (lambda: functools.partial(scaled, leaf()), r"'args\[0\]'"),
        (lambda: functools.partial(lambda z, w: scaled(w, z), w=leaf()), "'w'"),
        (lambda: functools.partial(closed(leaf())), "'w'"),
    ],
    ids=["variable", "global", "argument", "keyword", "within a partial"],
)
@pytest.mark.parametrize("layer", [zh.BlackBox, zh.SparseBlackBox])
def test_a_tensor_that_requires_grad_is_a_warning(fn, name, layer):
    function = fn()
    with pytest.warns(UserWarning, match=f"fn captures the tensor {name}, which is differentiated") as noted:
        layer(function, SMOOTHING)
    assert (len(noted), noted[0].filename) == (1, __file__)
    with torch.no_grad():  # nobody asks for a derivative; a warning is an error
        layer(function, SMOOTHING)


@pytest.mark.parametrize(
    "fn", [closed(torch.ones(1)), of_setting, Model().of_attribute, torch.nn.Linear(1, 1), torch.sum, Compiled()]
)
def test_other_functions_are_none(fn):
    zh.BlackBox(fn, SMOOTHING)


def test_a_variable_without_a_value_is_none():
    def fn(z):
        return scaled(late, z)

    zh.BlackBox(fn, SMOOTHING)
    late = torch.ones(1)
    assert float(fn(torch.ones(1, 1))) == float(late)


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacfwd])
def test_a_tensor_that_a_transform_differentiates_is_a_warning(transform):
    """The true derivative of mean(w x) is 2, and 0 is returned: of fn, and of a head."""
    x = torch.full((1,), 2.0)

    def of_fn(w):
        return zh.smooth(closed(w), SMOOTHING)(x)

    def of_head(w):
        return zh.smooth(lambda z: z, SMOOTHING, head=lambda y: scaled(w, y))(x)

    for function, role in ((of_fn, "fn"), (of_head, "head")):
        with pytest.warns(UserWarning, match=f"{role} captures the tensor 'w'.* {role} capture w.detach"):
            assert float(transform(lambda w, f=function: f(w).sum())(torch.ones(1))) == 0.0


def test_a_head_that_captures_a_parameter_is_an_error_when_it_is_called():
    layer = zh.BlackBox(lambda z: z, SMOOTHING, head=closed(leaf()))  # no warning
    with pytest.raises(ValueError, match="head"):
        layer(torch.ones(1, requires_grad=True))
