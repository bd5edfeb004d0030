"""The commands `simulate` and `demo`."""

from __future__ import annotations

import argparse

from torchstickcal.cli.outputs import (
    EXIT_DONE,
    chosen_files,
    errors_by_camera,
    print_errors,
    show_results,
)
from torchstickcal.cli.progress import StagesProgress, progress, weights_of
from torchstickcal.cli.world import placed, world_of


def simulate(options: argparse.Namespace) -> int:
    from torchstickcal.files import atomic_set, try_writing
    from torchstickcal.simulate import session_specs, write_simulated
    from torchstickcal.simulate.render import write_film

    specs = session_specs(options.name, options.count, options.seed)
    try_writing(options.out, [f"{specs[0].name}.npz"])
    with progress(options) as bar:
        for number, spec in enumerate(specs):
            bar(number, len(specs), f"session {number + 1} of {len(specs)}: {spec.name}")
            session = spec.generate()
            with atomic_set(options.out) as folder:
                write_simulated(folder / f"{spec.name}.npz", session)
                if options.gif:
                    write_film(folder / f"{spec.name}.gif", session)
    print(f"{len(specs)} session{'s' if len(specs) > 1 else ''} in {options.out}")
    return EXIT_DONE


def demo(options: argparse.Namespace) -> int:
    from torchstickcal.config import load_config
    from torchstickcal.files import atomic_set, try_writing
    from torchstickcal.io import write_npz
    from torchstickcal.metrics import pose_errors
    from torchstickcal.pipeline.calibrate import calibrate
    from torchstickcal.show.rig import rig_figure
    from torchstickcal.simulate import Noise, golf_session

    files = chosen_files()
    try_writing(options.out, ["session.npz", "rig.png", *files.single_files])
    print(
        "A golf swing seen by 6 cameras: 240 frames, 1.5 px noise, 15 % of the keypoints missing, 5 % wrong by up to 150 px.\n"
    )
    observations, truth = golf_session(noise=Noise(sigma_px=1.5, missing=0.15, outliers=0.05), seed=options.seed)
    with progress(options) as bar:
        calibration = calibrate(observations, callback=StagesProgress(bar, weights_of(load_config())))
    calibration, _ = placed(calibration, world_of("athlete"))
    with atomic_set(options.out) as folder:
        write_npz(folder / "session.npz", observations, truth)
        files(calibration, folder, {"session": str(options.out / "session.npz"), "config": "default"})
        rig_figure(calibration).savefig(folder / "rig.png", format="png", dpi=120)
    status = show_results(calibration, options.out, files)
    print(f"picture in {options.out / 'rig.png'}\n\nAgainst the truth:")
    errors = pose_errors(calibration.rotations, calibration.translations, truth.rotations, truth.translations)
    print_errors(errors_by_camera(calibration.camera_names, errors))
    return status
