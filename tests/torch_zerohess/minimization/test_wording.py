"""Messages about the end of a search."""

import torch

from torch_zerohess.minimization.wording import worded


def test_a_message_names_a_few_parameters():
    untouched = torch.tensor([True, False, True, True])

    def said(which):
        return worded("used up", "budget", 0, "", which, arrived=False, success=False)

    assert said(untouched) == "used up; 3 of 4 parameters (0, 2, 3) were not found to change any output, and stay"
    assert said(~untouched & untouched) == said(None) == "used up"


def test_a_minimum_that_may_not_be_unique_is_said_once():
    def said(message, status="solved", *, success=True):
        return worded(message, status, 0, "", None, arrived=True, success=success, flat=True)

    words = "; along some direction the loss hardly changes: the minimum may not be unique"
    assert said("arrived") == "arrived" + words
    known = "arrived at points with the loss at x: the minimum is not unique"
    assert said(known) == known
    assert said("reached", "target") == "reached"
    assert said("used up", "callback", success=False) == "used up"


def test_after_failures_a_search_that_stalled_says_what_fn_may_return_instead():
    def said(status, failed):
        return worded("ended", status, 0, "", None, arrived=False, success=False, failed=failed)

    advice = "; let fn return a loss that grows with the violation, or outputs, with a penalty in loss="
    assert said("stalled", 3) == said("budget", 3) + advice
    assert "violation" not in said("budget", 3) + said("stalled", 0)


def test_a_message_says_what_holds_at_the_end_where_that_helps():
    which = torch.arange(8) > 1

    def said(status, **more):
        return worded("ended", status, 0, "", None, arrived=False, success=False, **more)

    assert said("solved", at_bounds=which) == "ended; 6 of 8 parameters (2, 3, 4, 5, 6, ...) lie at a bound"
    assert said("target", at_bounds=which, narrow=which) == said("failed", at_bounds=which, narrow=which) == "ended"
    found = {"found": 3, "evaluations": 9}
    assert said("budget", **found) == said("time", **found) == "ended; x was found by evaluation 3 of 9"
    assert said("solved", **found) == said("budget") == "ended"
    plateau = worded("ended", "budget", 9, "", None, arrived=False, success=False, **found)
    assert plateau == "ended; all 9 values are equal: enlarge sigma"
