"""Where black-box evaluations run."""

from torch_zerohess.evaluators.batch import LostEvaluationError
from torch_zerohess.evaluators.evaluator import Evaluator
from torch_zerohess.evaluators.executor import Executor
from torch_zerohess.evaluators.factory import Factory
from torch_zerohess.evaluators.inline import Inline
from torch_zerohess.evaluators.process_pool import ProcessPool
from torch_zerohess.evaluators.ray import Ray

__all__ = ["Evaluator", "Executor", "Factory", "Inline", "LostEvaluationError", "ProcessPool", "Ray"]
