"""Errors of workers that never evaluate anything, with what to do about them."""

import os
import sys


def unstarted(how: str) -> RuntimeError:
    """Return the error for a worker that ended before it got a black box, with what to do about it."""
    main = getattr(sys.modules["__main__"], "__file__", None)
    what = "put the main part of the script"
    if main is not None and not os.path.isfile(main):  # "<stdin>"
        what = "this program is in no file, as if read from the standard input: write it into one, its main part"
    return RuntimeError(
        f"a worker process ended with {how} at its start, see its messages above. Workers import the main program: "
        f'{what} under `if __name__ == "__main__":`'
    )


def unmade(error: BaseException) -> BaseException:
    """Return an error of a worker that could not make the black box, with what to do about it."""
    text = str(error)
    if isinstance(error, AttributeError) and "main__" in text:
        hint = RuntimeError(
            f"fn could not be loaded in a worker ({text}): put it into a module, a .py file that is imported here, or "
            "to the top of the script, outside of functions and of `if`"
        )
        hint.__cause__ = error
        return hint
    return error
