"""Messages about the end of a search."""

import torch

from torch_zerohess.minimization.wording import worded


def test_a_message_names_a_few_parameters():
    untouched = torch.tensor([True, False, True, True])

    def said(which):
        return worded("used up", "budget", 0, "", which, arrived=False, success=False)

    assert said(untouched) == "used up; 3 of 4 parameters (0, 2, 3) were not found to change any output, and stay"
    assert said(~untouched & untouched) == said(None) == "used up"
