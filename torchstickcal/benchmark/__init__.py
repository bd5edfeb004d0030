"""The paper's tables and figures, and harder ones, over sessions with known truth."""

from torchstickcal.benchmark.bound import Bound, camera_bound
from torchstickcal.benchmark.cases import Case, Source, sources
from torchstickcal.benchmark.methods import METHODS, Method, method
from torchstickcal.benchmark.page import write_results
from torchstickcal.benchmark.run import Row, run_benchmark
from torchstickcal.benchmark.scores import SequenceScore, score_sequence, summarise

__all__ = [
    "METHODS",
    "Bound",
    "Case",
    "Method",
    "Row",
    "SequenceScore",
    "Source",
    "camera_bound",
    "method",
    "run_benchmark",
    "score_sequence",
    "sources",
    "summarise",
    "write_results",
]
