"""The table of `make fuzz`."""

from __future__ import annotations

import pytest

from fuzz.promise import LARGE, TALLIES


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Subjects, cases, and how they ended."""
    if not LARGE:
        return
    ways = ["converged", "not converged", "loaded", "accepted", "refused", "faults"]
    terminalreporter.section("table for docs/robustness.md")
    terminalreporter.write_line(f"| what | cases | {' | '.join(ways)} |")
    terminalreporter.write_line(f"|---|{'---|' * (1 + len(ways))}")
    for subject, tally in sorted(TALLIES.items()):
        terminalreporter.write_line(f"| {subject} | {tally['cases']} | {' | '.join(str(tally[way]) for way in ways)} |")
