"""A setting of an object that may be set later on, and is checked each time."""

from collections.abc import Callable
from typing import Any


class CheckedSetting:
    """An attribute whose values pass through `check`, which raises for a wrong one; `then` is called afterwards."""

    def __init__(self, check: Callable[[Any], Any], then: Callable[[Any], None] = lambda owner: None) -> None:
        self.check, self.then = check, then

    def __set_name__(self, kind: type, name: str) -> None:
        self.name = name

    def __get__(self, owner: Any, kind: type) -> Any:
        return self if owner is None else vars(owner)[self.name]

    def __set__(self, owner: Any, value: Any) -> None:
        vars(owner)[self.name] = self.check(value)
        self.then(owner)
