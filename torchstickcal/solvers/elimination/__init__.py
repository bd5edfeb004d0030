"""Exact elimination of the points (Schur complement), so that a solver sees a small dense system in the cameras."""
