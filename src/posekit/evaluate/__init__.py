"""Data set + estimator -> tables: stages, scores, results, report, comparison."""

from posekit.evaluate.compare import Comparison, Difference, compare
from posekit.evaluate.options import EvalOptions
from posekit.evaluate.run import Outcome, evaluate

__all__ = ["Comparison", "Difference", "EvalOptions", "Outcome", "compare", "evaluate"]
