"""Benchmarks on sessions with known truth: tables and figures like those of the paper, and more difficult sessions.

A comparison method of your own is registered with :func:`baseline` and then found in :data:`METHODS`.
"""

from torchstickcal.benchmark.baselines import (
    BASELINES,
    Baseline,
    Estimate,
    Inputs,
    Listing,
    MissingInputError,
    PublishedErrors,
    baseline,
)
from torchstickcal.benchmark.bound import Bound, camera_bound
from torchstickcal.benchmark.cases import Case, Source, sources
from torchstickcal.benchmark.external import ExternalPoses
from torchstickcal.benchmark.methods import METHODS, Method, method
from torchstickcal.benchmark.page import write_results
from torchstickcal.benchmark.run import Row, run_benchmark
from torchstickcal.benchmark.scores import SequenceScore, score_external, score_sequence, summarise

__all__ = [
    "BASELINES",
    "METHODS",
    "Baseline",
    "Bound",
    "Case",
    "Estimate",
    "ExternalPoses",
    "Inputs",
    "Listing",
    "Method",
    "MissingInputError",
    "PublishedErrors",
    "Row",
    "SequenceScore",
    "Source",
    "baseline",
    "camera_bound",
    "method",
    "run_benchmark",
    "score_external",
    "score_sequence",
    "sources",
    "summarise",
    "write_results",
]
