"""From videos to keypoints: one folder for a session, whose table of keypoints the readers take.

OUT/keypoints.csv        camera, frame, time_s, point, x, y, score; all cameras
OUT/videos.json          of each camera: file, size, frame rate, frames, and what was looked for
OUT/cameras/CAM.csv      the same table of one camera, as soon as its video is done
OUT/cameras/CAM.json     what it was made of; a video that is done is not read again
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.files import atomic_set, json_text
from torchstickcal.io.skeletons import skeleton as skeleton_named
from torchstickcal.io.skeletons import skeletons_of
from torchstickcal.untrusted import read_json
from torchstickcal.video.frames import frame_numbers, frames_at, frames_of, video_info
from torchstickcal.video.pose import BodyDetector
from torchstickcal.video.shaft import SHAFT_POINTS, shaft_in, shaft_track
from torchstickcal.video.tape import Background, TapeTrack, candidates, check_colours, ends_of, learned, sampled

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
"""called with the name of a camera, the frames that are done, and their number (0 where that is not known)"""

_COLUMNS = ("camera", "frame", "time_s", "point", "x", "y", "score")
_HAND_REACH, _STICK_REACH = 0.4, 1.3
"""How far from the hands the first and the other markers can be, as shares of the diagonal of the body's box."""
_LEAST_SCORE = 0.3


@dataclass(frozen=True, eq=False)
class VideoKeypoints:
    """What was found in the video of one camera."""

    camera: str
    frames: NDArray[np.int64]
    """(F,), numbers of the frames; those of frames that were dropped are left out"""
    times: Array
    """(F,), seconds"""
    fps: float
    """frames per second, by the times"""
    size: tuple[int, int]
    """width and height, pixels"""
    points: tuple[str, ...]
    keypoints: Array
    """(F, P, 3), x and y in pixels and a score; NaN, NaN, 0 where not seen"""


def detect_video(
    path: str | Path,
    camera: str,
    body: BodyDetector | None = None,
    tapes: Sequence[str] = (),
    skeleton: str | None = None,
    progress: Progress | None = None,
    shaft: bool = False,
    balls: Sequence[str] = (),
) -> VideoKeypoints:
    """Find the athlete's keypoints and the stick in a video.

    Args:
        path: of the video.
        camera: its name.
        body: finds the keypoints of the body in an image; None to look for the stick alone.
        tapes: colours of the bands of tape on the stick, keys of :data:`~torchstickcal.video.tape.HUES`; the first one is
            nearest to the hands. The points are called ``tape_red`` and so on. The camera must stand still.
        skeleton: the names of the body's points; None to know it by their number.
        progress: called after every frame.
        shaft: whether to look for a stick without marks, as a line from the hands. The points are called ``shaft_hands`` and
            ``shaft_end``. The camera must stand still.
        balls: colours of balls on the stick, as ``tapes``, of which only one can be given. The points are called ``ball_red``
            and so on.

    Raises:
        CalibrationError: if there is nothing to look for, the skeleton is not known, or a shaft is to be found without the
            wrists.
        FileFormatError: if the file is no video, or damaged.
        FileNotFoundError: if there is no such file.
    """
    if shaft and body is None:
        raise _no_wrists(path, "no body keypoints")
    if tapes and balls:
        raise CalibrationError("two kinds of marks", where="--balls", got="--tape too", expected="one of the two")
    marks = [*tapes, *balls]
    if body is None and not marks:
        raise CalibrationError(
            "nothing to look for in a video",
            where=str(path),
            got="neither weights nor marks on the stick",
            expected="one of them, or both",
            remedy="Give --rtmlib or --weights for the body, and --balls, --tape or --shaft for the stick.",
        )
    if marks:
        check_colours(marks, "--balls" if balls else "--tape")
    info = video_info(path)
    times: list[float] = []
    people: list[Array] = []
    for time_s, image in frames_of(path):
        times.append(time_s)
        if body is not None:
            people.append(np.asarray(body(image), dtype=np.float64))
        if progress is not None:
            progress(camera, len(times), info.frames)
    names = _names(len(people[0]), skeleton) if people else ()
    numbers, fps = frame_numbers(np.array(times))
    parts = [np.stack(people)] if people else []
    points = (*names, *(f"{'ball' if balls else 'tape'}_{name}" for name in marks))
    if marks or shaft:
        background = _background(path, marks, people, len(times))
        tracks = _mark_tracks(path, background, marks, people, names)
        parts += [ends[:, None] for ends in ends_of(tracks, balls=bool(balls))]
        parts += [_shaft(path, background, people, names)] if shaft else []
        points += SHAFT_POINTS if shaft else ()
    return VideoKeypoints(camera, numbers, np.array(times), fps, info.size, points, np.concatenate(parts, axis=1))


def detect(
    paths: Sequence[str | Path],
    out: str | Path,
    make_body: Callable[[], BodyDetector] | None = None,
    tapes: Sequence[str] = (),
    skeleton: str | None = None,
    progress: Progress | None = None,
    settings: dict[str, Any] | None = None,
    shaft: bool = False,
    balls: Sequence[str] = (),
) -> list[str]:
    """Find keypoints in the videos of a rig and write the folder of a session. Videos that were done before are not read again.

    Args:
        paths: of the videos, one for each camera; a camera has the name of its file.
        out: the folder.
        make_body: makes a detector for each video; None for none.
        tapes, skeleton, progress, shaft, balls: as of :func:`detect_video`.
        settings: what else the results depend on; videos that were done with others are read again.

    Returns:
        Sentences about what was found.

    Raises:
        CalibrationError: if two videos have one name, and as :func:`detect_video`.
    """
    out = Path(out)
    cameras = [Path(path).stem for path in paths]
    if repeated := {name for name in cameras if cameras.count(name) > 1}:
        raise CalibrationError(
            "two videos of one name", where="VIDEO", got=sorted(repeated)[0], expected="a name for each camera",
            remedy="Call the files after their cameras.",
        )  # fmt: skip
    notes = []
    for path, camera in zip(paths, cameras, strict=True):
        made_of = {"file": str(path), "bytes": Path(path).stat().st_size if Path(path).is_file() else None}
        made_of |= {"tapes": list(tapes), "skeleton": skeleton, "body": make_body is not None, "shaft": shaft}
        made_of |= {"balls": list(balls)}
        made_of |= settings or {}
        if _is_done(out, camera, made_of):
            notes.append(f"{camera}: done before.")
            continue
        body = None if make_body is None else make_body()
        found = detect_video(path, camera, body, tapes, skeleton, progress, shaft, balls)
        with atomic_set(out / "cameras") as folder:
            _write_table(folder / f"{camera}.csv", found)
            content = {"made_of": made_of, "fps": found.fps, "image_size": found.size, "frames": len(found.frames)}
            content["points"] = {n: _share_seen(found, k) for k, n in enumerate(found.points)}
            (folder / f"{camera}.json").write_text(json_text(content) + "\n", "utf-8")
        notes.append(_about(found))
    _join(out, cameras)
    return notes


def _background(path: str | Path, marks: Sequence[str], people: Sequence[Array], frames: int) -> Background:
    chosen = sampled(frames)
    return learned(frames_at(path, set(chosen)), marks, [people[number] for number in chosen] if people else ())


def _mark_tracks(
    path: str | Path, background: Background, marks: Sequence[str], people: Sequence[Array], names: Sequence[str]
) -> list[TapeTrack]:
    """What may be the marks of each colour."""
    if not marks:
        return []
    tracks = [TapeTrack() for _ in marks]
    for frame, (_, image) in enumerate(frames_of(path)):
        for number, (name, track) in enumerate(zip(marks, tracks, strict=True)):
            reach = _HAND_REACH if number == 0 else _STICK_REACH
            near = _near_hands(people[frame], names, reach) if people else None
            track.add(candidates(image, background, name, near), near)
    return tracks


def _shaft(path: str | Path, background: Background, people: Sequence[Array], names: Sequence[str]) -> Array:
    """The shaft (F, 2, 3) in each frame, by the hands."""
    if not {"left_wrist", "right_wrist"} & set(names):
        raise _no_wrists(path, "no point left_wrist or right_wrist")
    found = []
    for person, (_, image) in zip(people, frames_of(path), strict=True):
        near = _near_hands(person, names, 1.0)
        nothing = np.full((len(SHAFT_POINTS), 3), [np.nan, np.nan, 0.0])
        found.append(nothing if near is None else shaft_in(image, background.image, near[:2], near[2]))
    return shaft_track(found)


def _no_wrists(path: str | Path, got: str) -> CalibrationError:
    return CalibrationError(
        "a shaft is found from the hands on, and the hands are not known", where=str(path), got=got,
        expected="body keypoints with the wrists", remedy="Give --weights or --rtmlib, and the --skeleton if it is not known.",
    )  # fmt: skip


def _names(points: int, skeleton: str | None) -> tuple[str, ...]:
    if skeleton is not None:
        return skeleton_named(skeleton, points)
    known = skeletons_of(points)
    if not known:
        raise CalibrationError(
            "a skeleton that is not known", where="--skeleton", got=f"{points} points", expected="the name of their skeleton"
        )
    return skeleton_named(known[0])


def _near_hands(person: Array, names: Sequence[str], reach: float) -> tuple[float, float, float] | None:
    """Middle between the wrists, and how far a marker can be from it; None where the wrists were not seen."""
    seen = person[:, 2] >= _LEAST_SCORE
    wrists = [k for k, name in enumerate(names) if name in ("left_wrist", "right_wrist") and seen[k]]
    if not wrists:
        return None
    x, y = person[wrists, :2].mean(0)
    return float(x), float(y), reach * float(np.linalg.norm(np.ptp(person[seen, :2], axis=0)))


def _share_seen(found: VideoKeypoints, point: int) -> float:
    return float((found.keypoints[:, point, 2] > 0).mean())


def _about(found: VideoKeypoints) -> str:
    dropped = int(found.frames[-1]) + 1 - len(found.frames)
    text = f"{found.camera}: {len(found.frames)} frames, {found.fps:.3f} Hz"
    text += f", {dropped} dropped" if dropped else ""
    for number, name in enumerate(found.points):
        if name.startswith(("tape_", "ball_", SHAFT_POINTS[-1])):
            text += f", {name} in {100 * _share_seen(found, number):.0f} %"
    return f"{text}."


def _write_table(path: Path, found: VideoKeypoints) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for frame, time_s, points in zip(found.frames.tolist(), found.times, found.keypoints, strict=True):
            for name, (x, y, score) in zip(found.points, points, strict=True):
                if score > 0 and np.isfinite([x, y]).all():
                    row = found.camera, frame, f"{time_s:.6f}", name, f"{x:.3f}", f"{y:.3f}", f"{min(score, 1.0):.4f}"
                    writer.writerow(row)


def _is_done(out: Path, camera: str, made_of: dict[str, Any]) -> bool:
    try:
        return (out / "cameras" / f"{camera}.csv").is_file() and read_json(_part(out, camera))["made_of"] == made_of
    except (FileNotFoundError, FileFormatError, KeyError, TypeError):
        return False


def _part(out: Path, camera: str) -> Path:
    return out / "cameras" / f"{camera}.json"


def _join(out: Path, cameras: Sequence[str]) -> None:
    """Write the tables of all cameras as one."""
    content = {camera: json.loads(_part(out, camera).read_text("utf-8")) for camera in cameras}
    with atomic_set(out) as folder:
        (folder / "videos.json").write_text(json_text(content) + "\n", "utf-8")
        with (folder / "keypoints.csv").open("w", encoding="utf-8", newline="") as file:
            file.write(",".join(_COLUMNS) + "\n")
            for camera in cameras:
                _, _, rows = (out / "cameras" / f"{camera}.csv").read_text("utf-8").partition("\n")
                file.write(rows)
