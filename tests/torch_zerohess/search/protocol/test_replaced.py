"""Copies with other fields are those of `dataclasses.replace`."""

import dataclasses
import functools
from typing import ClassVar

import pytest

from torch_zerohess.search.protocol.replaced import replace


@dataclasses.dataclass(frozen=True)
class Numbers:
    kind: ClassVar[str] = "numbers"
    first: int
    second: int = 2

    @functools.cached_property
    def both(self) -> int:
        return self.first + self.second


@dataclasses.dataclass(frozen=True)
class More(Numbers):
    third: int = 3


@pytest.mark.parametrize("known", [Numbers(1), More(1, third=5)])
@pytest.mark.parametrize("changes", [{}, {"first": 7}, {"first": 7, "second": 8}])
def test_copies_are_those_of_dataclasses(known: Numbers, changes: dict[str, int]) -> None:
    assert known.both == known.first + known.second
    copy = replace(known, **changes)
    assert copy == dataclasses.replace(known, **changes)
    assert type(copy) is type(known)
    assert copy.both == copy.first + copy.second
    assert known.first == 1


def test_a_field_that_is_lacking_is_refused() -> None:
    with pytest.raises(TypeError, match="Numbers has no field third"):
        replace(Numbers(1), third=4)


def test_classes_that_do_more_than_to_set_their_fields_are_refused() -> None:
    @dataclasses.dataclass(frozen=True)
    class Made:
        first: int
        twice: int = dataclasses.field(init=False, default=0)

    @dataclasses.dataclass(frozen=True)
    class Checked:
        first: int

        def __post_init__(self) -> None:
            assert self.first

    for known in (Made(1), Checked(1)):
        with pytest.raises(ValueError, match="must have no __post_init__"):
            replace(known, first=2)
