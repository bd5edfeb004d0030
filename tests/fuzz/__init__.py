"""The project's own fuzzing suite: hostile and merely unlucky inputs against the promise of docs/robustness.md.

One file describes the cases of one subject, in words that a failing test prints and that can be run again. One file tests
them. What must hold of each is in `promise.py`.
"""
