"""The command `info`."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from torchstickcal.cli.calibrate import given_of
from torchstickcal.cli.console import note
from torchstickcal.cli.outputs import EXIT_DONE, try_json, write_json
from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.observations import Observations

_TRIED = 60
"""Frames by which the accuracy is estimated."""
_FEW = 20
"""Keypoints that two cameras must have in common to be placed by them."""


def info(options: argparse.Namespace) -> int:
    from torchstickcal.io import load_session

    try_json(options.json)
    given = given_of(options)
    session = load_session(options.session, options.format, replace(given, stick=given.stick or []))
    for sentence in session.notes:
        note(sentence)
    found = _found(session.observations) | {"expected": _expected(session.observations)}
    print(_table(found))
    write_json(options.json, found | {"notes": list(session.notes)})
    return EXIT_DONE


def _found(observations: Observations) -> dict[str, Any]:
    """What a session holds, as JSON can hold it."""
    seen, labels = observations.visible, observations.camera_labels
    size = observations.image_size
    sizes = [None] * len(labels) if size is None else size.expand(len(labels), 2).tolist()
    shares = seen.double().mean(1)  # (C, P)
    common = [
        {"cameras": [labels[first], labels[second]], "keypoints": int((seen[first] & seen[second]).sum())}
        for first in range(len(labels))
        for second in range(first + 1, len(labels))
    ]
    return {
        "frames": observations.num_frames,
        "fps": observations.fps,
        "intrinsics_known": observations.intrinsics_known,
        "cameras": [
            {"name": name, "image_size": size, "frames": int(own.any(-1).sum()), "keypoints": int(own.sum())}
            for name, size, own in zip(labels, sizes, seen, strict=True)
        ],
        "points": [
            {"name": observations.point_label(point), "seen": dict(zip(labels, shares[:, point].tolist(), strict=True))}
            for point in range(observations.num_points)
        ],
        "triangulated": float((seen.sum(0) >= 2).double().mean()),
        "pairs": common,
        "sticks": [
            {"start": observations.point_label(stick.ends[0]), "end": observations.point_label(stick.ends[1])}
            | {"length_m": stick.length_m, "frames": int((seen[..., list(stick.ends)].sum(0) >= 2).all(-1).sum())}
            for stick in observations.sticks
        ],
    }


def _expected(observations: Observations) -> dict[str, Any]:
    """How exact a calibration becomes, by one of some frames; as JSON can hold it."""
    import torch

    from torchstickcal.pipeline.calibrate import calibrate

    if not observations.sticks:
        return {"unknown": "no stick is given (--stick)"}
    if observations.timestamps is not None:
        return {"unknown": "the cameras have times of their own"}
    frames = torch.linspace(0, observations.num_frames - 1, min(_TRIED, observations.num_frames)).round().long()
    confidence = observations.confidence
    part = replace(
        observations,
        keypoints=observations.keypoints[:, frames],
        confidence=None if confidence is None else confidence[:, frames],
        fps=None,
    )
    try:
        calibration = calibrate(part, refine=())
    except CalibrationError as error:
        return {"unknown": f"{error.what}: {error.got}"}
    std_m = float(calibration.camera_std_m[1:].mean())
    return {"frames": len(frames), "position_std_m": std_m, "verdict": calibration.quality.verdict.value}


def _table(found: dict[str, Any]) -> str:
    """The same as a text to print."""
    from torchstickcal.show.tables import printable, text_table

    names = [camera["name"] for camera in found["cameras"]]
    rate = "unknown frame rate" if found["fps"] is None else f"{found['fps']:g} frames per second"
    known = "intrinsics are known" if found["intrinsics_known"] else "intrinsics are not known"
    text = [f"{len(names)} cameras, {found['frames']} frames, {len(found['points'])} points; {rate}; {known}.", ""]
    rows = [["camera", "image", "frames", "keypoints"]]
    for camera in found["cameras"]:
        size = "-" if camera["image_size"] is None else "x".join(f"{side:g}" for side in camera["image_size"])
        rows.append([printable(camera["name"]), size, str(camera["frames"]), str(camera["keypoints"])])
    text += [text_table(rows), ""]
    rows = [["point, seen in % of the frames by", *map(printable, names)]]
    for point in found["points"]:
        rows.append([printable(point["name"]), *(f"{100 * point['seen'][name]:.0f}" for name in names)])
    text += [text_table(rows), ""]
    rows = [["keypoints in common", "number", ""]]
    for pair in sorted(found["pairs"], key=lambda pair: -pair["keypoints"]):
        remark = "" if pair["keypoints"] >= _FEW else "too few to place one by the other"
        rows.append([" - ".join(map(printable, pair["cameras"])), str(pair["keypoints"]), remark])
    text += [text_table(rows), "", f"{100 * found['triangulated']:.0f} % of the points are seen by two cameras or more."]
    for stick in found["sticks"]:
        ends = f"{printable(stick['start'])} - {printable(stick['end'])}"
        text.append(f"Stick {ends}, {stick['length_m']:g} m: both ends are seen by two cameras in {stick['frames']} frames.")
    text.append(f"Expected accuracy: {_expectation(found['expected'], found['frames'])}")
    return "\n".join(text)


def _expectation(expected: dict[str, Any], frames: int) -> str:
    if "unknown" in expected:
        return f"not known, because {expected['unknown']}."
    if expected["verdict"] not in ("good", "usable"):
        return f"{expected['verdict']}, by {expected['frames']} of {frames} frames; `torchstickcal calibrate` says why."
    figure = f"standard deviation of the camera positions {1000 * expected['position_std_m']:.2g} mm"
    more = "; all frames together do better" if expected["frames"] < frames else ""
    return f"{figure}, by {expected['frames']} of {frames} frames{more}."
