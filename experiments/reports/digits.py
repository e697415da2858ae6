"""Numbers to a few digits, as all reports show them."""


def significant(value: float, digits: int) -> str:
    """Return a number to so many significant digits, without an exponent from 0.0001 up to a million.

    Example:
        >>> significant(12.3456, 3), significant(999.7, 3), significant(0.000123, 2), significant(2e7, 2)
        ('12.3', '1000', '0.00012', '2e+07')
    """
    return f"{float(f'{value:.{digits}g}'):g}"
