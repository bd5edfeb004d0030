"""The report of a calibration: one file of HTML with its data, its style and its script, which asks for nothing else."""

from __future__ import annotations

import base64
import hashlib
import math
import statistics
from collections.abc import Mapping, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from pathlib import PurePath
from typing import Any

from torchstickcal.files import json_text
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.verdict import Acceptance, LengthErrors, Quality
from torchstickcal.result import Calibration
from torchstickcal.show.look import CAMERA_COLOURS, COLOURS, digits, share, with_std
from torchstickcal.show.page.drawn import drawn
from torchstickcal.show.quality import meaning_of
from torchstickcal.show.tables import (
    CameraFacts,
    Column,
    Table,
    camera_facts,
    camera_table,
    point_table,
    printable,
    stage_table,
    stick_table,
    unknown_tables,
)

_SCRIPTS = ("data.js", "scene.js", "images.js", "charts.js", "main.js")
_SEVERITIES = {
    Severity.NOTE: ("note", "used"),
    Severity.CAUTION: ("caution", "usable"),
    Severity.SERIOUS: ("serious", "poor"),
    Severity.FATAL: ("fatal", "failed"),
}
"""What a severity is called, and the colour that it has."""
_CHECKED = {"focal": "Focal length", "time_offset": "Clock"}
"""What is said of each camera beside its image."""


def report_page(calibration: Calibration, provenance: Mapping[str, Any] | None = None) -> str:
    """The report of a calibration as a page that opens in any browser, without a network.

    Args:
        calibration: what was found.
        provenance: what it was made of, as JSON can hold it: the session, the configuration, notes, versions.

    Returns:
        HTML. The same calibration gives the same text.

    Example:
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.simulate import Noise, golf_session
        >>> calibration = calibrate(golf_session(cameras=3, frames=20, noise=Noise(1.0))[0])
        >>> page = report_page(calibration)
        >>> page.startswith("<!doctype html>"), "://" in page
        (True, False)
    """
    made_of = dict(provenance or {})
    data, cameras = drawn(calibration), camera_facts(calibration)
    title = _title(str(made_of.get("session", "")))
    script = "(() => {\n'use strict';\n" + "".join(map(_asset, _SCRIPTS)) + "})();\n"
    seal = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; script-src 'sha256-{seal}'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'"
    content = json_text(data, indent=False).replace("<", "\\u003c")
    body = "".join(
        [
            _head(calibration, title),
            _quality(calibration.quality),
            _tiles(calibration, cameras),
            _scene(calibration, data),
            _cameras(calibration, data, cameras),
            "</div>",
            _curves(calibration, data),
            _tables(calibration, cameras),
            _made_of(made_of),
        ]
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}: calibration report</title>\n<style>{_colours()}{_asset('style.css')}</style></head>\n"
        f"<body>{body}\n"
        f'<script type="application/json" id="data">{content}</script>\n<script>{script}</script></body></html>\n'
    )


def _title(session: str) -> str:
    """The names of the session's files, without their folders."""
    names = [PurePath(path).name for path in session.split(", ")]
    more = f" and {len(names) - 2} more" if len(names) > 3 else ""
    return printable(", ".join(names[:2] if more else names) + more) or "Calibration"


@cache
def _asset(name: str) -> str:
    return files("torchstickcal.show.page").joinpath(name).read_text("utf-8")


def _colours() -> str:
    """The colours as variables of CSS, on a light and on a dark ground; a printer's is light."""
    named = {**COLOURS, **{f"c{number}": colour for number, colour in enumerate(CAMERA_COLOURS)}}
    light = "".join(f"--{name}:{colour.light};" for name, colour in named.items())
    dark = "".join(f"--{name}:{colour.dark};" for name, colour in named.items())
    return f":root{{{light}}}@media screen and (prefers-color-scheme:dark){{:root:not(.printing){{{dark}}}}}\n"


def _head(calibration: Calibration, title: str) -> str:
    verdict = calibration.quality.verdict.value
    links = (("scene", "Scene"), ("cameras", "Cameras"), ("curves", "Over time"), ("tables", "Tables"), ("made-of", "Made of"))
    nav = "".join(f'<a href="#{place}">{name}</a>' for place, name in links)
    return (
        f'<header><p class="kind">torchstickcal calibration report</p><h1>{escape(title)}</h1><nav>{nav}</nav></header>'
        "<noscript><p class='notice'>Pictures and curves need JavaScript. Verdict and tables do not.</p></noscript>"
        f'<section class="verdict {verdict}" id="verdict"><p class="badge">{verdict}</p>'
        f"<p class='meaning'>The verdict is <b>{verdict}</b>: {escape(meaning_of(calibration.quality.verdict))}.</p>"
        f"{_first(calibration)}</section>"
    )


def _first(calibration: Calibration) -> str:
    """What to do first: the first finding that matters and has advice."""
    status = "" if calibration.converged else f"<p>Not converged: {escape(calibration.status)}.</p>"
    findings = (one for one in calibration.quality.findings if one.advice and one.severity > Severity.NOTE)
    first = next(findings, None)
    if first is None:
        return status
    meaning, advice = escape(printable(first.meaning)), escape(printable(first.advice))
    return f'{status}<p class="first"><b>Do first:</b> {meaning} <b>{advice}</b></p>'


def _quality(quality: Quality) -> str:
    """The acceptance test in millimetres, and the findings."""
    matters = [one for one in quality.findings if one.severity > Severity.NOTE]
    notes = [one for one in quality.findings if one.severity == Severity.NOTE]
    text = "<section><h2>Findings</h2>"
    text += (
        f"<ul class='findings'>{''.join(map(_finding, matters))}</ul>" if matters else "<p>Nothing that needs attention.</p>"
    )
    if notes:
        text += f"<details{'' if matters else ' open'}><summary>{len(notes)} {'note' if len(notes) == 1 else 'notes'}</summary>"
        text += f"<ul class='findings'>{''.join(map(_finding, notes))}</ul></details>"
    text += "</section>"
    return (_acceptance(quality.acceptance) if quality.acceptance else "") + text


def _finding(finding: Finding) -> str:
    name, colour = _SEVERITIES[finding.severity]
    advice = f' <span class="advice">{escape(printable(finding.advice))}</span>' if finding.advice else ""
    cause = " <small>cause</small>" if finding.is_cause else ""
    return (
        f'<li><span class="tag" style="--tag:var(--{colour})">{name}</span>{cause} {escape(printable(finding.meaning))}{advice}'
        f' <code title="a name for programs">{escape(finding.code)}</code></li>'
    )


def _acceptance(acceptance: Acceptance) -> str:
    text = f'<section class="acceptance"><h2>How right is a length?</h2><p class="sentence">{escape(acceptance.sentence)}</p>'
    if acceptance.lengths:
        columns = (
            Column("stick, predicted", is_text=True),
            Column("given", "m"),
            Column("frames", "", "frames whose keypoints took no part in the calibration that measures them"),
            Column("left out", "", "lengths that are wrong by more than 6 of their standard deviations: not in the errors"),
            Column("largest error", "mm"),
            Column("mean error", "mm"),
            Column("std", "mm", "standard deviation of the measured lengths"),
            Column("in their 95 % interval", "", "share of the lengths inside their own stated interval; about 95 % is right"),
            Column("volume", "m", "extent of the space in which the stick was"),
        )
        text += Table(
            "Lengths predicted by cameras that did not see them (VDI/VDE 2634)",
            columns,
            tuple(map(_lengths, acceptance.lengths)),
        ).html()
    known = [px for px in acceptance.left_out_px if math.isfinite(px)]
    left_out = (
        f" Each camera's keypoints lie {digits(min(known))} to {digits(max(known))} px (rms) from what the others predict."
        if known
        else ""
    )
    text += (
        f"<p>Projections lie {digits(acceptance.reprojection_px)} px (rms), {digits(acceptance.reprojection_mrad)} mrad, from "
        f"their keypoints; rays pass their points at {digits(1000 * acceptance.ray_distance_m)} mm (median)."
        f"{left_out} {escape(acceptance.focal_sentence)}</p></section>"
    )
    return text


def _lengths(one: LengthErrors) -> tuple[str, ...]:
    return (
        one.stick,
        f"{one.given_m:.4f}",
        str(one.frames),
        str(one.wrong),
        f"{1000 * one.largest_m:+.2f}",
        f"{1000 * one.mean_m:+.2f}",
        f"{1000 * one.std_m:.2f}",
        share(one.inside),
        " x ".join(digits(extent, 2) for extent in one.volume_m),
    )


def _tiles(calibration: Calibration, facts: Sequence[CameraFacts]) -> str:
    cameras, frames, points = calibration.inliers.shape
    seen, used = sum(camera.seen for camera in facts), sum(camera.used for camera in facts)
    relabelled = int((calibration.relabelled & calibration.inliers).sum())
    tiles = [
        ("cameras", str(cameras)),
        ("frames", str(frames)),
        ("points", str(points)),
        ("keypoints used", share(used / seen) if seen else "-"),
        ("keypoints set aside", str(seen - used)),
        ("relabelled", str(relabelled)),
        ("reprojection, median", f"{digits(_median([camera.median_px for camera in facts]))} px"),
        ("std of the scale", f"{digits(100 * float(calibration.scale_std), 2)} %"),
        ("largest std of a position", f"{digits(1000 * max(camera.std_m for camera in facts))} mm"),
    ]
    return f'<dl class="tiles">{"".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in tiles)}</dl>'


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return statistics.median(known) if known else math.nan


def _scene(calibration: Calibration, data: Mapping[str, Any]) -> str:
    """The scene in space. The section stays open: the slider is also that of the images."""
    views = "".join(
        f'<option value="{number}">{escape(printable(one["name"]))}</option>' for number, one in enumerate(data["cameras"])
    )
    far = data["scene"]["far"]
    left_out = f" {far} points lie far outside the scene and are not drawn." if far else ""
    thinned = f" Of {data['count']} frames every {_ordinal(data['step'])} is shown." if data["step"] > 1 else ""
    return (
        '<div class="moving"><section id="scene"><h2>Scene</h2><div class="stage"><canvas id="space" tabindex="0" role="img" '
        'aria-label="Cameras, athlete and stick in space"></canvas><output id="tip" hidden></output></div>'
        '<div class="controls"><label>View <select id="view"><option value="">free</option>'
        f"{views}</select></label><button id='nearer' type='button' aria-label='nearer'>+</button>"
        "<button id='farther' type='button' aria-label='farther'>&minus;</button>"
        "<button id='reset' type='button'>Reset</button>"
        "<label><input type='checkbox' id='show-names' checked> names</label>"
        "<label><input type='checkbox' id='show-path' checked> path of the stick</label>"
        "<label><input type='checkbox' id='show-ellipsoids' checked> uncertainty <span id='magnified'></span></label></div>"
        + _legend(
            ("line stick", "stick"),
            ("line body", "athlete"),
            ("ring aside", "a keypoint was set aside"),
            ("ring relabelled", "a label was corrected"),
            ("fill used", "ellipsoid that holds 95 %, magnified"),
        )
        + f"<p class='small'>{escape(calibration.world.description)} Metres. Drag to turn, with two fingers to zoom and tilt."
        f"{thinned}{left_out}</p></section>"
    )


def _legend(*keys: tuple[str, str]) -> str:
    """What signs mean: their classes of style, and words."""
    entries = "".join(f"<span><i class='{kind}'></i>{text}</span>" for kind, text in keys)
    return f'<p class="legend">{entries}</p>'


def _ordinal(number: int) -> str:
    return f"{number}{'th' if 10 <= number % 100 <= 20 else {1: 'st', 2: 'nd', 3: 'rd'}.get(number % 10, 'th')}"


def _cameras(calibration: Calibration, data: Mapping[str, Any], facts: Sequence[CameraFacts]) -> str:
    every = data["step"] * data["images"]["every"]
    thinned = f" Images: every {_ordinal(every)} frame." if every > 1 else ""
    modes = "".join(
        f"<label><input type='radio' name='mode' value='{value}'{' checked' if value == 'frame' else ''}>{text}</label>"
        for value, text in (("frame", "this frame"), ("residuals", "mean residuals"))
    )
    checks = _checks(calibration)
    cards = "".join(_card(calibration, data, camera, own, checks[camera]) for camera, own in enumerate(facts))
    return (
        f'<section id="cameras"><h2>Cameras</h2><div class="controls segmented" role="group" aria-label="Images show">{modes}'
        "<label><input type='checkbox' id='enlarge'> enlarge the part with keypoints</label></div>"
        + _legend(
            ("dot used", "keypoint, used"),
            ("cross aside", "set aside"),
            ("ring relabelled", "relabelled"),
            ("ring reprojection", "projection of the point"),
            ("fill used", "where keypoints were used"),
        )
        + f"<p class='small'>Right of each image: the residuals, projection minus keypoint, along x and y.{thinned}</p>"
        f'<div class="cards">{cards}</div></section>'
        '<div class="transport"><button id="play" type="button" aria-label="play">&#9654;</button>'
        '<input id="frame" type="range" min="0" max="0" value="0" step="1" aria-label="frame">'
        '<output id="when"></output></div>'
    )


def _card(
    calibration: Calibration, data: Mapping[str, Any], camera: int, own: CameraFacts, checks: Sequence[tuple[str, str]]
) -> str:
    """One camera: its image, its residuals, and what is known of it."""
    image = data["cameras"][camera]
    place = f"± {digits(1000 * own.std_m)} mm, ± {digits(own.std_deg)} deg"
    facts = [
        ("Keypoints used", f"{own.used} ({share(own.used / own.seen) if own.seen else '-'})"),
        ("Image covered", share(image["covered"])),
        ("Reprojection", f"{digits(own.median_px)} px median, {digits(own.rms_px)} px rms"),
        ("Position, rotation", "the reference" if camera == 0 and own.std_m == 0 else place),
        *checks,
    ]
    other = int(calibration.other_person[camera].sum())
    if other:
        facts.append(("Frames of another person", str(other)))
    rows = "".join(f"<div><dt>{title}</dt><dd>{escape(text)}</dd></div>" for title, text in facts)
    colour = f"--camera:var(--c{camera % len(CAMERA_COLOURS)})"
    return (
        f'<article class="card" style="{colour}"><h3>{escape(printable(own.name))} {_tags(calibration, own.name)}</h3>'
        f'<div class="pictures"><canvas class="image" data-camera="{camera}" role="img" aria-label="image plane" '
        f'style="aspect-ratio:{image["width"]:.0f}/{image["height"]:.0f}"></canvas>'
        f'<canvas class="cloud" data-camera="{camera}" role="img" aria-label="residuals"></canvas></div>'
        f"<dl>{rows}</dl></article>"
    )


def _checks(calibration: Calibration) -> list[list[tuple[str, str]]]:
    """Focal length and clock of each camera: what was given or estimated, and what the keypoints suggest."""
    found: list[list[tuple[str, str]]] = [[] for _ in calibration.camera_names]
    for name, title in _CHECKED.items():
        parameter = calibration.unknowns.get(name)
        if parameter is None:
            continue
        factor, unit = (1000, "ms") if parameter.unit == "s" else (1, parameter.unit)
        tensors = ("value", "std", "given", "suggested", "suggested_std")
        rows = zip(*((factor * parameter.by_component(which)[:, 0]).tolist() for which in tensors), strict=True)
        for camera, (value, std, given, suggested, suggested_std) in enumerate(rows):
            if parameter.refined:
                said = f"{with_std(value, std)} {unit} estimated, {with_std(given, math.nan)} given"
            elif math.isfinite(suggested) and not (camera == 0 and name == "time_offset"):
                said = f"{with_std(given, math.nan)} {unit} given, {with_std(suggested, suggested_std)} suggested"
            elif math.isfinite(given):
                said = f"{with_std(given, math.nan)} {unit} given"
            else:
                continue
            found[camera].append((title, said))
    return found


def _tags(calibration: Calibration, name: str) -> str:
    """The findings that are about a camera."""
    about = [one for one in calibration.quality.findings if name in one.cameras and one.severity > Severity.NOTE]
    return "".join(
        f'<span class="tag" style="--tag:var(--{_SEVERITIES[one.severity][1]})" title="{escape(printable(one.text))}">'
        f"{escape(one.code.replace('_', ' '))}</span> "
        for one in about
    )


def _curves(calibration: Calibration, data: Mapping[str, Any]) -> str:
    """Everything over time, and the course of the adjustment; the script draws it."""
    size = data["time"]["size"]
    thinned = f"<p class='small'>One place of a curve stands for {size} frames.</p>" if size > 1 else ""
    sticks = "".join(
        _figure(
            f"Length of the stick {stick['name']}, {digits(stick['given_m'], 4)} m, minus the given one{_left_out(stick)}",
            f"data-chart='stick' data-number='{number}'",
        )
        for number, stick in enumerate(data["time"]["sticks"])
    )
    over_time = (
        ("residual", "Residuals of each camera, median of a frame"),
        ("used", "Share of the keypoints that was used, of those seen"),
        ("visibility", "Visibility: how many cameras used each point"),
    )
    course = (
        ("cost", "How far the cost is above its last value, in each stage"),
        ("reprojection", "Reprojection error of each camera, weighted rms (px)"),
    )
    return (
        f'<section id="curves"><h2>Over time</h2>{thinned}{sticks}'
        f"{''.join(_figure(text, f'data-chart={name}') for name, text in over_time)}</section>"
        f'<section id="convergence"><h2>Convergence</h2><p>{escape(calibration.status)}</p><div class="pair">'
        f"{''.join(_figure(text, f'data-chart={name}') for name, text in course)}</div></section>"
    )


def _figure(caption: str, attributes: str) -> str:
    """The place of a chart that the script draws."""
    return f'<figure><figcaption>{escape(printable(caption))}</figcaption><div class="chart" {attributes}></div></figure>'


def _left_out(stick: Mapping[str, Any]) -> str:
    missing = stick["left_out"]
    return f"; {missing} frames are left out, in which an end is not known" if missing else ""


def _tables(calibration: Calibration, cameras: Sequence[CameraFacts]) -> str:
    stick = stick_table(calibration)
    tables = [
        camera_table(cameras),
        *unknown_tables(calibration),
        *([stick] if stick else []),
        point_table(calibration),
        stage_table(calibration),
    ]
    return f'<section id="tables"><h2>Tables</h2>{"".join(table.html() for table in tables)}</section>'


def _made_of(provenance: Mapping[str, Any]) -> str:
    """The session, the configuration and the versions."""
    rows = "".join(
        f"<div><dt>{escape(printable(str(name)))}</dt><dd>{_value(value)}</dd></div>" for name, value in provenance.items()
    )
    return (
        f'<section id="made-of"><h2>Made of</h2><dl class="facts">{rows}</dl></section>'
        if rows
        else '<section id="made-of"></section>'
    )


def _value(value: Any) -> str:
    if isinstance(value, dict) and any(isinstance(part, (dict, list)) for part in value.values()):
        return f"<details><summary>show</summary><pre>{escape(json_text(value))}</pre></details>"
    if isinstance(value, dict):
        return ", ".join(f"{escape(printable(str(name)))} {escape(printable(str(part)))}" for name, part in value.items())
    if isinstance(value, list):
        return "<br>".join(escape(printable(str(part))) for part in value)
    return escape(printable(str(value)))
