"""Errors about what a function of the caller returned: their messages name the function, and what would be right."""


class ReturnedError(Exception):
    """What a function returned is wrong."""


class ReturnedTypeError(ReturnedError, TypeError):
    """It has a wrong type."""


class ReturnedValueError(ReturnedError, ValueError):
    """It has a wrong shape, or numbers that are out of range."""
