"""Where black-box evaluations run."""

from torch_zerohess.evaluators.inline import Evaluator, Inline

__all__ = ["Evaluator", "Inline"]
