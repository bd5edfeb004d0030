"""Exact elimination of the points by the Schur complement. A small dense system in the cameras remains."""
