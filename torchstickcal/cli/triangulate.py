"""The command `triangulate`."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

from torchstickcal.cli.analyse import write_analysis
from torchstickcal.cli.calibrate import given_of
from torchstickcal.cli.configuration import made_with, triangulation_config
from torchstickcal.cli.console import note
from torchstickcal.cli.outputs import EXIT_DONE, point_writers, write_json
from torchstickcal.cli.progress import StagesProgress, progress
from torchstickcal.files import REPORT_FILE

_STAGES = {"points": 1.0, "trajectories": 2.0}
"""The stages, and how long each of them takes in comparison with the other."""


def triangulate_session(options: argparse.Namespace) -> int:
    from torchstickcal.files import atomic_set, try_writing
    from torchstickcal.io import Motion, Rig, load_session
    from torchstickcal.io.results import read_result
    from torchstickcal.outputs import check_frame_rate
    from torchstickcal.pipeline.triangulate import triangulate
    from torchstickcal.show.reconstruction import summary, table

    config = triangulation_config(options)
    writers = point_writers(options.write)
    try_writing(options.out, [*writers, REPORT_FILE])
    calibration = read_result(options.calibration)
    if isinstance(calibration, Rig):
        calibration = calibration.in_metres(options.units if calibration.unit is None else None)
    rig = calibration if isinstance(calibration, Rig) else Rig.of_calibration(calibration)
    given = given_of(options)
    given = replace(given, intrinsics=rig, stick=given.stick or [])
    session = load_session(options.session, options.format, given)
    for sentence in session.notes:
        note(sentence)
    check_frame_rate(writers, session.observations)
    with progress(options) as bar:
        listener = StagesProgress(bar, _STAGES).on_iteration
        found = triangulate(session.observations, calibration, config, turned=options.turned, listener=listener)
    with atomic_set(options.out) as folder:
        for name, writer in writers.items():
            writer.write(folder / name, Motion.of(found))
        write_json(folder / REPORT_FILE, _provenance(options, list(session.notes)) | summary(found))
    print(table(found))
    print(f"\n{', '.join([*writers, REPORT_FILE])} in {options.out}")
    if options.analyse is not None:
        print()
        write_analysis(found, options.out / "analysis", options.analyse, "c3d" if "points.c3d" in writers else None)
    return EXIT_DONE


def _provenance(options: argparse.Namespace, notes: list[str]) -> dict[str, Any]:
    return {
        "session": ", ".join(map(str, options.session)),
        "calibration": str(options.calibration),
        **made_with(options.config, options.set),
        **({"notes": notes} if notes else {}),
    }
