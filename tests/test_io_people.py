"""Several people in view: who is who in time and across cameras, and who of them is the athlete."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchstickcal import CalibrationError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.io import Detection, View
from torchstickcal.io.people import Athlete, athlete_of
from torchstickcal.simulate import SPORTS, SessionSpec
from torchstickcal.simulate.skeleton import JOINTS

FRAMES = 60
SIZE = (1920, 1080)


class Scene:
    """Athletes of several sports in one place; the first one has the stick, the others walk past."""

    def __init__(self, seed: int, cameras: int, people: int, twins: bool = False) -> None:
        rng = np.random.default_rng(seed)
        sports = [sport for sport in SPORTS if sport != "wand"]
        sessions = [
            SessionSpec(
                "one", sports[int(rng.integers(len(sports)))], seed=10 * seed + n, cameras=cameras, frames=FRAMES
            ).generate()
            for n in range(people)
        ]
        truth, self.cameras = sessions[0].truth, sessions[0].observations.cameras
        bodies = [session.truth.points.numpy() for session in sessions]
        head, ankle = JOINTS.index("head_top"), JOINTS.index("left_ankle")
        axes = [_upright(body[:, head] - body[:, ankle], rng.uniform(0, 7)) for body in bodies]
        placed = [bodies[0]]
        for body, own in zip(bodies[1:], axes[1:], strict=True):
            way = np.linspace(-1, 1, FRAMES) * rng.uniform(0.3, 2.0) + rng.uniform(-0.5, 0.5)
            aside = rng.uniform(0.6, 1.5) * rng.choice([-1, 1])
            moved = (body - body[:, ankle].mean(0)) @ own.T @ axes[0] + bodies[0][:, ankle].mean(0)
            walking = moved + way[:, None, None] * axes[0][0] + aside * axes[0][1]
            placed.append(bodies[0] + axes[0][1] if twins else walking)
        self.views, self.sticks, self.who = [], [], []
        for camera, (rotation, translation) in enumerate(zip(truth.rotations.numpy(), truth.translations.numpy(), strict=True)):
            lens = Intrinsics(self.cameras.matrix[camera : camera + 1], None)
            pixels = [lens.project(torch.from_numpy(p @ rotation.T + translation).reshape(1, -1, 3))[0] for p in placed]
            noisy = [p.numpy().reshape(FRAMES, -1, 2) + 3 * rng.standard_normal((FRAMES, 21, 2)) for p in pixels]
            rows = [(frame, person) for frame in range(FRAMES) for person in rng.permutation(people).tolist()]
            rows = [row for row in rows if rng.uniform() > 0.03]
            for body in noisy:
                body[rng.uniform(size=body.shape[:2]) < 0.1] = np.nan
            self.views.append(View.of(f"c{camera}", [Detection(f, noisy[person][f, :19]) for f, person in rows]))
            self.sticks.append(View.of_tracks(f"c{camera}", noisy[0][None, :, 19:]))
            self.who.append(np.array([person for _, person in rows]))

    def athlete(self, how: str, stick: bool = False, cameras: Intrinsics | None = None) -> Athlete:
        size = torch.tensor(SIZE, dtype=torch.float64).expand(len(self.views), 2)
        lenses = Intrinsics(self.cameras.matrix, None) if cameras is None else cameras
        return athlete_of(self.views, [0] * len(self.views), how, JOINTS, lenses, size, self.sticks if stick else None)

    def found(self, athlete: Athlete) -> tuple[int, float, float]:
        """Who was found, in which share of the rows it is that person, and in which share of those of that person."""
        rows = np.concatenate([own[one] for own, one in zip(self.who, athlete.rows, strict=True)])
        person = int(np.bincount(rows).argmax())
        right = (rows == person).sum()
        return person, right / len(rows), right / sum((own == person).sum() for own in self.who)


def _upright(body: np.ndarray, angle: float) -> np.ndarray:
    """Axes (3, 3) of which the last one is up."""
    up = body.mean(0) / np.linalg.norm(body.mean(0))
    side = np.cross(up, [1.0, 0, 0.3])
    side /= np.linalg.norm(side)
    ahead = np.cross(up, side)
    turned = np.cos(angle) * side + np.sin(angle) * ahead
    return np.stack([turned, np.cross(up, turned), up])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(3, cameras=4, people=3)


@pytest.mark.parametrize(("seed", "cameras", "people"), [(1, 3, 2), (4, 5, 2), (5, 3, 4)])
def test_who_has_the_stick_is_found_in_every_camera(seed: int, cameras: int, people: int):
    scene = Scene(seed, cameras, people)
    athlete = scene.athlete("auto", stick=True)
    person, right, complete = scene.found(athlete)
    assert person == 0
    assert right > 0.98
    assert complete > 0.9
    assert "nearest to the stick" in athlete.notes[0]
    assert "not sure" not in athlete.notes[0]
    for view, rows in zip(scene.views, athlete.rows, strict=True):
        assert len(np.unique(view.frames[rows])) == len(rows)


def test_cameras_with_other_clocks():
    """Geometry then fits nobody; who is near the stick still says who it is."""
    scene = Scene(7, cameras=3, people=2)
    for camera, late in enumerate((0, 15, 6)):
        for views in (scene.views, scene.sticks):
            views[camera] = replace(views[camera], frames=views[camera].frames + late)
    athlete = scene.athlete("auto", stick=True)
    person, right, complete = scene.found(athlete)
    assert person == 0
    assert right > 0.98
    assert complete > 0.9
    assert all(len(rows) > 0.8 * FRAMES for rows in athlete.rows)


@pytest.mark.parametrize("how", ["largest", "central", "moving"])
def test_whoever_is_chosen_is_one_person(how: str, scene: Scene):
    _, right, complete = scene.found(scene.athlete(how))
    assert right > 0.98
    assert complete > 0.9


def test_the_choice_does_not_depend_on_the_order_of_people(scene: Scene):
    other = Scene.__new__(Scene)
    other.__dict__ |= scene.__dict__
    other.views, other.who = [], []
    for view, own in zip(scene.views, scene.who, strict=True):
        order = np.lexsort((own, view.frames))
        other.views.append(replace(view, keypoints=view.keypoints[order]))
        other.who.append(own[order])
    assert scene.found(other.athlete("largest"))[0] >= 0
    assert other.found(other.athlete("auto", stick=True))[0] == 0


def test_a_number_of_the_tracker_chooses(scene: Scene):
    other = Scene.__new__(Scene)
    other.__dict__ |= scene.__dict__
    other.views = [replace(view, persons=own + 5) for view, own in zip(scene.views, scene.who, strict=True)]
    assert other.found(other.athlete("6")) == (1, 1.0, 1.0)
    with pytest.raises(CalibrationError, match=r"nobody has this number .*got 1; expected one of 5, 6, 7"):
        other.athlete("1")
    with pytest.raises(CalibrationError, match=r"nobody has this number .*the files number nobody"):
        scene.athlete("0")


@pytest.mark.parametrize("how", ["stick", "tallest", ""])
def test_a_choice_that_there_is_not(how: str, scene: Scene):
    with pytest.raises(CalibrationError, match=r"no way to choose the athlete .*largest, central, moving, stick, auto"):
        scene.athlete(how)


def test_twins_are_said_to_be_unsure():
    """Two people of the same size who do the same."""
    scene = Scene(2, cameras=3, people=2, twins=True)
    athlete = scene.athlete("auto")
    assert scene.found(athlete)[1] > 0.98
    assert "This is not sure; --person chooses another." in athlete.notes[0]
    assert scene.found(scene.athlete("auto", stick=True))[0] == 0


def test_cameras_that_cannot_be_compared_are_said_to_be_unsure():
    """Three points that stand still say nothing of the cameras."""
    views = [
        View.of(f"c{n}", [Detection(f, 99 * np.eye(3, 2) + 300 * person + 1) for f in range(2) for person in range(2)])
        for n in range(2)
    ]
    athlete = athlete_of(views, [0, 0], "auto", None, None, torch.tensor([SIZE, SIZE]), None)
    assert "This is not sure; --person chooses another." in athlete.notes[0]
    assert [len(rows) for rows in athlete.rows] == [2, 2]


def test_one_person_is_not_talked_about():
    views = [View.of_tracks(f"c{n}", np.full((1, 5, 3, 2), 7.0 + n)) for n in range(2)]
    athlete = athlete_of(views, [0, 0], "auto", None, None, torch.tensor([SIZE, SIZE]), None)
    assert [rows.tolist() for rows in athlete.rows] == [[0, 1, 2, 3, 4]] * 2
    assert athlete.notes == ()
