"""A session is calibrated with a status that is true, or refused."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from fuzz.configurations import usable
from fuzz.promise import budget, case, check_calibration, check_shares
from fuzz.sessions import Spoiled, observations_of, spoiled_sessions
from fuzz.spoils.keypoints import SPOILS
from torchstickcal import calibrate


@budget(small=20, large=2000)
@given(
    session=st.one_of(spoiled_sessions(list(SPOILS)), spoiled_sessions(list(SPOILS)), spoiled_sessions()),
    config=st.one_of(st.just("default"), usable()),
)
def test_observations(session: Spoiled, config: Any):
    arguments = session.arguments()
    with case("observations") as ended:
        calibration = calibrate(observations_of(arguments), config)
        ended("converged" if calibration.converged else "not converged")
        check_calibration(calibration)


def test_most_sessions_reach_the_solver():
    check_shares("observations", "converged", "not converged", at_least=0.4)
