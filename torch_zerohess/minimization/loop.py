"""The loop of a search: step by step to its end."""

import contextlib

from torch_zerohess.minimization.callback import Callback
from torch_zerohess.minimization.constant import warn_of_constant, warn_of_steps
from torch_zerohess.minimization.failure import failure
from torch_zerohess.minimization.measured_derivatives import measure
from torch_zerohess.minimization.minimum import Status
from torch_zerohess.minimization.outcome import outcome
from torch_zerohess.minimization.running import Running
from torch_zerohess.minimization.stopping import Stopping

End = tuple[Status, str]
"""How a search has ended, and why."""


def run(running: Running, stopping: Stopping, callback: Callback | None, black_box: str) -> End:
    """Evaluate what the search asks for until it ends, and return its end.

    Ctrl-C is an end, too, if anything was evaluated. Another exception passes, with the `Minimum` so far as its
    attribute `minimum`.

    Args:
        running: the search.
        stopping: when it ends.
        callback: what `running` calls after every batch; or None.
        black_box: name of what evaluates, for the message about an exception.
    """
    try:
        return _end(running, stopping, callback)
    except KeyboardInterrupt:
        if not running.evaluations:
            raise
        return "interrupted", "interrupted"
    except (Exception, SystemExit) as error:  # a simulator may end by sys.exit
        if running.evaluations:
            caller = "callback" if callback is not None and callback.running else black_box
            with contextlib.suppress(Exception):  # nothing takes the place of the caller's own error
                error.minimum = outcome(running, "failed", failure(error, caller))  # type: ignore[union-attr]
                running.say()
        raise


def _end(running: Running, stopping: Stopping, callback: Callback | None) -> End:
    """Step until the search ends, and decide in noise which point is the best one."""
    seen = running.record.complete
    while True:
        running.look_again()
        end = stopping.reason(running)
        if end is not None and end[0] == "target" and running.look_again(at_target=True):
            continue
        if end is None and callback is not None and callback.asked:
            end = "callback", "the callback asked to end"
        if end is None:
            running.step()
            warn_of_constant(running.record, seen)
            warn_of_steps(running.record, running.search.loss)
            seen = running.record.complete
            continue
        if end[0] == "solved" and not running.noise:
            measure(running)
        if end[0] != "time":
            running.decide()
        decided = stopping.reason(running)  # in noise the decision may refute the target, or find it reached
        if decided is not None and decided[0] == "target" and end[0] != "callback":
            end = decided
        if end[0] != "target" or decided == end:
            return end
