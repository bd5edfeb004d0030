"""The page of a calibration: what is in it, how large it is, and what it does in a browser."""

from __future__ import annotations

import base64
import json
import re
import time
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.browser import CHROMIUM, browser_page
from torchstickcal import Calibration, Observations, calibrate
from torchstickcal.cli import main
from torchstickcal.io import write_npz
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.verdict import Quality
from torchstickcal.show.page.drawn import drawn
from torchstickcal.show.page.page import report_page
from torchstickcal.simulate import Noise, golf_session

EVIL = "</script><script>alert('x')</script>&\"'"
OBSERVATIONS, TRUTH = golf_session(cameras=3, frames=24, noise=Noise(sigma_px=1.0, missing=0.1, outliers=0.05))


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(OBSERVATIONS)


def data_of(page: str) -> dict[str, Any]:
    return json.loads(page.split('id="data">')[1].split("</script>")[0])


def numbers(packed: dict[str, Any]) -> np.ndarray:
    integers = np.frombuffer(base64.b64decode(packed["int16"]), "<i2")
    return np.where(integers == -32768, np.nan, integers * packed["factor"])


def with_clocks(o: Observations) -> Observations:
    times = np.arange(24) / 100 + np.array([[0.0], [0.0013], [0.004]])
    times[1, 5:8] = np.nan
    keypoints = o.keypoints.clone()
    keypoints[1, 5:8] = torch.nan
    return replace(o, keypoints=keypoints, timestamps=times)


def with_gap(o: Observations) -> Observations:
    keypoints = o.keypoints.clone()
    keypoints[:, 8:13] = torch.nan
    keypoints[:, :, 4] = torch.nan
    return replace(o, keypoints=keypoints)


@pytest.mark.parametrize(
    "change",
    [
        lambda o: o,
        lambda o: replace(o, point_names=None, image_size=None, fps=None),
        lambda o: o.of_cameras([0, 1]),
        lambda o: replace(o, distortion=[0.1, -0.05, 0.001, 0.002], keypoints=o.keypoints.float()),
        with_clocks,
        with_gap,
    ],
    ids=["plain", "bare", "two cameras", "lens", "clocks", "gaps"],
)
def test_a_page_of_any_calibration_is_whole(change: Callable[[Observations], Observations], tmp_path: Path):
    found = calibrate(change(OBSERVATIONS))
    page = report_page(found)
    data = data_of(page)
    assert data["count"] == len(found.points)
    points = numbers(data["scene"]["points"]).reshape(found.points.shape) + data["scene"]["middle"]
    near = np.isfinite(points)
    given = found.points.double().numpy()
    assert np.abs(points - given)[near].max() < 1e-3
    assert (~near & np.isfinite(given)).any(-1).sum() == data["scene"]["far"]
    assert found.quality.verdict in page
    for name in found.camera_names:
        assert name in page

    found.save(tmp_path / "points.npz")
    assert report_page(Calibration.load(tmp_path / "points.npz")) == page, "the same calibration gives the same bytes"


def test_keypoints_and_residuals_of_the_images_are_those_of_the_session(calibration: Calibration):
    images = drawn(calibration)["images"]
    keypoints = numbers(images["keypoints"]).reshape(calibration.residuals_px.shape)
    own = OBSERVATIONS.keypoints.numpy()
    straight = calibration.inliers.numpy() & ~calibration.relabelled.numpy()
    assert np.abs(keypoints - own)[straight].max() < 0.1
    roots = numbers(images["residuals"]).reshape(calibration.residuals_px.shape)
    used = calibration.inliers.numpy()
    assert np.abs(roots * np.abs(roots) - calibration.residuals_px.numpy())[used].max() < 0.05


def test_a_page_asks_for_nothing_and_names_cannot_break_it(calibration: Calibration):
    names = tuple(f"{EVIL}{number}" for number in range(3))
    points = tuple(f"{EVIL}{number}" for number in range(calibration.points.shape[1]))
    finding = Finding("code", Severity.SERIOUS, f"{names[0]} {EVIL}", EVIL, cameras=(names[0],))
    quality = Quality((finding,), calibration.quality.acceptance)
    renamed = replace(calibration, camera_names=names, point_names=points, judgement=quality)
    page = report_page(renamed, {"session": EVIL, "notes": [EVIL], "configuration": {EVIL: {EVIL: 1}}})
    assert page.count("<script") == 2
    assert "<script>alert" not in page
    assert data_of(page)["cameras"][0]["name"] == names[0]
    assert EVIL in unescape(page)
    shown = page.replace(page.split('id="data">')[1].split("</script>")[0], "")
    assert not re.findall(r"https?:|//[a-z]|\burl\((?!#)|@import|\bsrc=|fetch\(|XMLHttpRequest", shown)
    assert set(re.findall(r'href="(.)', page)) == {"#"}
    assert "default-src 'none'" in page


def long(calibration: Calibration, frames: int) -> Calibration:
    """The calibration as of a longer session: its frames again and again."""
    times = -(-frames // len(calibration.points))

    def again(tensor: torch.Tensor, axis: int) -> torch.Tensor:
        return torch.cat([tensor] * times, axis).narrow(axis, 0, frames)

    return replace(
        calibration,
        points=again(calibration.points, 0),
        stick_lengths_m=again(calibration.stick_lengths_m, 0),
        residuals_px=again(calibration.residuals_px, 1),
        inliers=again(calibration.inliers, 1),
        keypoint_index=again(calibration.keypoint_index, 1),
        other_person=again(calibration.other_person, 1),
        frame_index=torch.arange(frames).expand(len(calibration.camera_names), -1).contiguous(),
        times=torch.arange(frames).double() / 100,
        judgement=calibration.quality,
    )


def test_a_page_stays_small_and_is_made_fast():
    six = calibrate(golf_session(cameras=6, frames=30, noise=Noise(1.0, missing=0.1))[0])
    session = long(six, 3000)
    began = time.process_time()
    page = report_page(session)
    assert time.process_time() - began < 3.0
    assert len(page) < 5e6
    assert data_of(page)["step"] == 1, "every frame of such a session is shown"


def test_a_long_session_is_thinned_and_the_page_says_so(calibration: Calibration):
    page = report_page(long(calibration, 30_000))
    data = data_of(page)
    step = data["step"]
    assert step > 1
    assert len(page) < 5e6
    assert f"Of 30000 frames every {step}th is shown" in page
    assert f"Images: every {step * data['images']['every']}th frame" in page
    assert f"One place of a curve stands for {data['time']['size']} frames" in page


def test_calibrate_writes_the_page_and_report_makes_it_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    session, out = tmp_path / "swing & <hit>.npz", tmp_path / "results"
    write_npz(session, OBSERVATIONS)
    assert main(["calibrate", str(session), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("verdict: good")
    assert "why it stopped" not in shown
    written = (out / "report.html").read_bytes()
    for word in (b"swing &amp; &lt;hit&gt;.npz", b"torchstickcal", b"max_offset_s", b"A length of 1 m"):
        assert word in written
    (out / "report.html").unlink()
    assert main(["report", str(out)]) == 0
    assert (out / "report.html").read_bytes() == written

    assert main(["calibrate", str(session), "--out", str(out), "--verbose"]) == 0
    assert "why it stopped" in capsys.readouterr().out


def test_report_refuses_what_is_no_result(tmp_path: Path, calibration: Calibration, capsys: pytest.CaptureFixture[str]):
    assert main(["report", str(tmp_path)]) == 2
    assert "points.npz" in capsys.readouterr().err
    calibration.save(tmp_path / "points.npz")
    for content in ("[1, 2]", "{", '"x"'):
        (tmp_path / "report.json").write_text(content)
        assert main(["report", str(tmp_path)]) == 2
        assert "report.json" in capsys.readouterr().err
    assert not (tmp_path / "report.html").exists()
    (tmp_path / "report.json").unlink()
    assert main(["report", str(tmp_path)]) == 0


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_the_slider_moves_everything_without_an_error_or_a_request(tmp_path: Path, calibration: Calibration):
    names = ("left <b>", "right & far", "top")
    file = tmp_path / "report.html"
    file.write_text(report_page(replace(calibration, camera_names=names), {"session": "swing"}), "utf-8")
    picture = "document.getElementById('{}').toDataURL()"
    image = "document.querySelector('canvas.image').toDataURL()"
    moment = "document.getElementById('when').textContent"
    with browser_page(tmp_path / "profile") as page:
        page.open(file)
        before = [page.evaluate(picture.format("space")), page.evaluate(image), page.evaluate(moment)]
        page.evaluate("frame.value = 20; frame.dispatchEvent(new Event('input'))")
        after = [page.evaluate(picture.format("space")), page.evaluate(image), page.evaluate(moment)]
        assert all(one != other for one, other in zip(before, after, strict=True))
        assert after[2].startswith("frame 20")
        assert page.evaluate("document.querySelectorAll('.chart svg path').length") > 10
        assert page.evaluate("document.querySelector('.chart .now').getAttribute('x1') > 60")

        page.evaluate("document.getElementById('space').scrollIntoView({behavior: 'instant', block: 'center'})")
        x, y = page.evaluate("(() => { const b = space.getBoundingClientRect(); return [b.x + 200, b.y + 100]; })()")
        page.drag((x, y), (x + 150, y + 40))
        assert page.evaluate(picture.format("space")) != after[0], "the mouse turns the scene"
        for click in ("#view", "#nearer", "#reset", "#enlarge", "input[value=residuals]", "#show-ellipsoids", "#play", "#play"):
            page.evaluate(f"document.querySelector('{click}').click()")
        page.evaluate("view.value = '1'; view.dispatchEvent(new Event('change'))")

        page.open(file, width=390, height=800)
        assert page.evaluate("document.documentElement.scrollWidth") == 390, "nothing is wider than a phone"

        page.call("Emulation.setEmulatedMedia", media="print")
        page.open(file, width=700, height=800)
        assert page.evaluate("[...document.querySelectorAll('.wide')].every((one) => one.scrollWidth <= one.clientWidth)")
        assert page.errors == []
        assert set(page.requests) == {file.as_uri()}
