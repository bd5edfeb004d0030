"""The command `sample`."""

from __future__ import annotations

import argparse
import io
import zipfile
from importlib import resources

from torchstickcal.cli.outputs import EXIT_DONE

_SAMPLE = "golf.zip"


def sample(options: argparse.Namespace) -> int:
    from torchstickcal.files import atomic_set, try_writing

    folder = options.folder
    try_writing(folder, where="FOLDER")
    content = (resources.files("torchstickcal.samples") / _SAMPLE).read_bytes()
    with atomic_set(folder) as temporary, zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(temporary)
    print(f"A golf swing seen by four cameras, in {folder}. To calibrate it:\n")
    print(
        f"torchstickcal calibrate {folder} --skeleton {folder / 'skeleton.toml'} --stick club_grip club_head 1.0 --out results"
    )
    return EXIT_DONE
