"""Many sessions: the same results however they are calibrated, nothing lost and nothing twice, and failures as rows."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import torch

from torchstickcal import (
    Calibration,
    CalibrationError,
    FileFormatError,
    Observations,
    ResultFiles,
    Stick,
    calibrate,
    calibrate_many,
    load_config,
)
from torchstickcal.cli import main
from torchstickcal.cli.arguments import parser
from torchstickcal.cli.calibrate_many import _Writing
from torchstickcal.io import Given, write_npz
from torchstickcal.many import SessionFile, SessionRow, engine, many, read_manifests, session_files, tables
from torchstickcal.many.manifest import open_manifest
from torchstickcal.many.memory import Budget, needed_bytes
from torchstickcal.many.sources import Source, sources_of
from torchstickcal.many.task import Performed, Settings, Task, failed_row, folder_of, perform
from torchstickcal.processes import SPAWN
from torchstickcal.simulate import Noise, golf_session

KILLS = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="the system cannot kill")


def swing(seed: int) -> Observations:
    return golf_session(cameras=3, frames=8 + seed, noise=Noise(0.5), seed=seed)[0]


def _blind(observations: Observations) -> Observations:
    """The session, of which no camera sees anything."""
    return dataclasses.replace(observations, keypoints=torch.full_like(observations.keypoints, torch.nan))


def no_swing(error: str) -> Observations:
    raise ValueError(error)


def deadly(marks: Path, seed: int) -> Observations:
    """A session whose first process is killed while it has it."""
    if not any(marks.iterdir()):
        (marks / "dead").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return swing(seed)


SWINGS = {f"swing {seed}": partial(swing, seed) for seed in range(3)}


class Slowly(Executor):
    """An executor that performs what it was given last first, in this thread."""

    def __init__(self) -> None:
        self.given: list[tuple[Future[Any], Any]] = []

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.given.append((future, partial(fn, *args, **kwargs)))
        if len(self.given) == len(SWINGS):
            for waiting, call in reversed(self.given):
                waiting.set_result(call())
        return future


def figures(rows: Any) -> list[dict[str, Any]]:
    """The rows without their times."""
    return [dataclasses.asdict(row) | {"seconds": 0} for row in rows]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """The sessions, calibrated by processes of this machine."""
    out = tmp_path_factory.mktemp("many") / "out"
    return out, calibrate_many(SWINGS, out=out, jobs=2)


# --- results -----------------------------------------------------------------------------------------------------------------


def test_each_session_is_calibrated_as_if_it_were_alone(expected: tuple[Path, Any]):
    out, done = expected
    assert [row.name for row in done.rows] == list(SWINGS)
    for row, session in zip(done.rows, SWINGS.values(), strict=True):
        alone, found = calibrate(session()), done.calibration(row.name)
        assert torch.equal(found.points.nan_to_num(), alone.points.nan_to_num())
        assert torch.equal(found.translations, alone.translations)
        assert (row.outcome, row.cameras, row.frames) == ("converged", 3, alone.frame_index.shape[1])
        assert row.keypoints == int(alone.inliers.sum())
        assert row.centre_std_m == float(alone.camera_std_m.max())
    assert read_manifests(out) == {row.name: row for row in done.rows}


@pytest.mark.parametrize("executor", [partial(ThreadPoolExecutor, 2), Slowly])
def test_executor_and_order_change_nothing(executor: Any, expected: tuple[Path, Any], tmp_path: Path):
    with executor() as pool:
        done = calibrate_many(dict(reversed(SWINGS.items())), executor=pool, out=tmp_path)
    assert figures(reversed(done.rows)) == figures(expected[1].rows)
    for name in SWINGS:
        assert torch.equal(done.calibration(name).rotations, expected[1].calibration(name).rotations)
    lines = [json.loads(line) | {"seconds": 0} for line in (tmp_path / "sessions.jsonl").read_text().splitlines()]
    assert lines == figures(expected[1].rows)


def test_on_a_dask_cluster_of_two_workers(expected: tuple[Path, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    distributed = pytest.importorskip("distributed", reason="needs Dask")
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", paths)  # the workers import this file
    for name, session in SWINGS.items():
        write_npz(tmp_path / f"{name}.npz", session())
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        with client.get_executor() as executor:
            done = calibrate_many(SWINGS, executor=executor, out=tmp_path / "a")
        sessions = [str(tmp_path / f"{name}.npz") for name in SWINGS]
        command = ["calibrate-many", *sessions, "--cluster", cluster.scheduler_address, "--out", str(tmp_path / "b")]
        assert main([*command, "--refine", "none"]) == 0
    assert figures(done.rows) == figures(expected[1].rows)
    for row, same in zip(read_manifests(tmp_path / "b").values(), expected[1].rows, strict=True):
        assert row.reprojection_px == same.reprojection_px


def test_without_a_folder_the_results_are_in_memory():
    sessions = iter([swing(1), partial(swing, 2)])
    with ThreadPoolExecutor(1) as pool:
        done = calibrate_many(sessions, executor=pool)
    assert [row.name for row in done.rows] == ["000000", "000001"]
    assert torch.equal(done.calibration("000000").rotations, calibrate(swing(1)).rotations)
    with pytest.raises(CalibrationError, match="no session of that name"):
        done.calibration("swing")


def test_failures_are_rows_and_are_tried_again_only_if_that_is_asked_for(tmp_path: Path):
    path = tmp_path / "sessions" / "a.npz"
    path.parent.mkdir()
    path.write_bytes(b"nothing")
    sessions = {
        "file": path,
        "missing": tmp_path / "b.npz",
        "raises": partial(no_swing, "no <b>"),
        "other": str,
        "good": swing(0),
    }
    out = tmp_path / "out"

    def run(**more: Any) -> tuple[dict[str, SessionRow], int]:
        with ThreadPoolExecutor(1) as pool:
            done = calibrate_many(sessions, executor=pool, out=out, **more)
        return {row.name: row for row in done.rows}, len((out / "manifest.jsonl").read_text().splitlines())

    rows, lines = run()
    assert {name: row.outcome for name, row in rows.items()} == dict.fromkeys(sessions, "failed") | {"good": "converged"}
    errors = {"file": "no session format", "missing": "FileNotFoundError", "raises": "ValueError: no <b>", "other": "got str"}
    for name, error in errors.items():
        assert error in str(rows[name].error)
    assert run() == (rows, lines) == (rows, 5)
    write_npz(path, swing(1))
    rows, lines = run(retry=True)
    assert (rows["file"].outcome, rows["raises"].outcome, lines) == ("converged", "failed", 9)
    assert run() == (rows, 9)

    page = (out / "index.html").read_text()
    assert "2 converged, 3 failed" in page
    assert "no &lt;b&gt;" in page
    links: list[str] = []

    class Links(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            links.extend(value or "" for key, value in attrs if key == "href")

    Links().feed(page)
    assert sorted(link.rpartition("/")[2] for link in links) == ["report.html", "report.html", "sessions.csv", "sessions.jsonl"]
    assert all((out / link).is_file() for link in links)


def test_many_sessions_have_the_files_of_one(tmp_path: Path):
    write_npz(tmp_path / "swing.npz", swing(0))
    one = tmp_path / "one"
    assert main(["calibrate", str(tmp_path / "swing.npz"), "--write", "trc,camera_array.toml", "--out", str(one)]) == 0
    expected = {path.name for path in one.iterdir()}
    assert {"report.html", "points.trc", "camera_array.toml"} <= expected
    with ThreadPoolExecutor(1) as pool:
        for page, linked in ((True, "report.html"), (False, "report.json")):
            out, files = tmp_path / f"page {page}", ResultFiles(("trc", "camera_array.toml"), page=page)
            calibrate_many({"swing": swing(0)}, refine="auto", executor=pool, out=out, write=files)
            assert {path.name for path in (out / "results" / "swing").iterdir()} == expected - {"report.html"} | {linked}
            assert f"results/swing/{linked}" in (out / "index.html").read_text()


def test_the_command_can_leave_the_page_out():
    command = ["calibrate-many", "sessions", "--out", "results"]
    assert parser().parse_args(command).page
    assert not parser().parse_args([*command, "--no-page"]).page


@pytest.mark.parametrize(
    ("formats", "error"),
    [
        (("nonsense",), "unknown output format"),
        (("a/b.trc",), "another folder"),
        (("report.html.trc", "POINTS.npz"), "one name"),
    ],
)
def test_files_that_cannot_be_written_together_are_refused_before_anything_is_calculated(formats: tuple[str, ...], error: str):
    with pytest.raises(CalibrationError, match=error):
        ResultFiles(formats)


# --- small sessions together -------------------------------------------------------------------------------------------------


def group(sessions: dict[str, Any], out: Path | None = None, memory_bytes: int | None = None) -> tuple[Task, ...]:
    settings = pickle.dumps(Settings(load_config("default"), None, out, ResultFiles(page=False), memory_bytes))
    return tuple(Task(Source(name, session), "", None, settings) for name, session in sessions.items())


def test_a_group_has_the_results_of_its_sessions_alone(tmp_path: Path):
    alike = {str(seed): golf_session(cameras=3, frames=8, noise=Noise(0.5), seed=seed)[0] for seed in range(3)}
    sessions = alike | {"other": swing(1), "raises": partial(no_swing, "no"), "no rig": _blind(swing(0)), "last": swing(0)}
    performed = perform(group(sessions, tmp_path))
    assert [row.name for row, _ in performed.done] == list(sessions)
    singly = [perform(group({name: session})).done[0] for name, session in sessions.items()]
    for (row, _), (alone, calibration) in zip(performed.done, singly, strict=True):
        assert (row.outcome, row.status, row.error, row.verdict) == (alone.outcome, alone.status, alone.error, alone.verdict)
        if calibration is not None:
            found = Calibration.load(tmp_path / str(row.folder) / "points.npz")
            torch.testing.assert_close(found.points, calibration.points, rtol=0, atol=1e-12, equal_nan=True)
            torch.testing.assert_close(found.rotations, calibration.rotations, rtol=0, atol=1e-12)
    assert [row.outcome for row, _ in performed.done].count("failed") == 2


def test_a_large_session_of_a_group_is_left_for_a_call_of_its_own():
    small, large = swing(0), golf_session(cameras=6, frames=140)[0]
    assert perform(group({"large": large, "small": small})) == ([], 1)
    performed = perform(group({"raises": partial(no_swing, "no"), "small": small, "large": large, "last": small}))
    assert [row.name for row, _ in performed.done] == ["raises", "small"]


def test_a_group_takes_no_more_memory_than_is_allowed():
    sessions = {str(seed): swing(seed) for seed in range(3)}
    two = needed_bytes(*list(sessions.values())[:2])
    assert [len(perform(group(sessions, None, memory)).done) for memory in (two, two - 1)] == [2, 1]


# --- what is interrupted -----------------------------------------------------------------------------------------------------


@KILLS
def test_a_killed_worker_costs_no_session(tmp_path: Path):
    marks = tmp_path / "marks"
    marks.mkdir()
    sessions = {"once": partial(deadly, marks, 0), "cannot be sent": lambda: swing(0), "other": SWINGS["swing 1"]}
    done = calibrate_many(sessions, out=tmp_path / "out", jobs=1)
    assert [row.outcome for row in done.rows] == ["converged", "failed", "converged"]
    assert "pickle" in str(done.rows[1].error)
    assert (tmp_path / "out" / "manifest.jsonl").read_text().count("\n") == len(sessions)


class Mortal:
    """Processes of which one is killed when it begins with a session that has deaths left."""

    def __init__(self, deaths: dict[str, int], groups: list[int]) -> None:
        self.deaths, self.groups = deaths, groups

    def __call__(self, *_: Any) -> Mortal:
        self.alive = True
        return self

    def __enter__(self) -> Mortal:
        return self

    def __exit__(self, *_: Any) -> None:
        pass

    def submit(self, _: Any, group: tuple[Task, ...]) -> Future[Performed]:
        future: Future[Performed] = Future()
        self.groups.append(len(group))
        for task in group if self.alive else ():
            if self.deaths.get(task.source.name, 0):
                self.deaths[task.source.name] -= 1
                self.alive = False
        if self.alive:
            future.set_result(Performed([(failed_row(task, "done"), None) for task in group], together=5))
        else:
            future.set_exception(BrokenExecutor())
        return future


@pytest.mark.parametrize(
    "deaths", [{}, {0: 1}, {3: 99}, {7: 1, 9: 2}, {6: 99, 7: 99}, {12: 3, 19: 1}, dict.fromkeys(range(20), 1)]
)
@pytest.mark.parametrize("count", [1, 3])
def test_a_deadly_session_costs_no_other(deaths: dict[int, int], count: int, monkeypatch: pytest.MonkeyPatch):
    groups: list[int] = []
    monkeypatch.setattr(engine, "_started", Mortal({str(n): times for n, times in deaths.items()}, groups))
    tasks = [Task(Source(str(n), str), "", None, b"") for n in range(20)]
    rows = [row for done in engine.on_processes(iter(tasks), count, None, None) for row, _ in done]
    assert sorted(int(row.name) for row in rows) == list(range(20))
    errors = {int(row.name): str(row.error) for row in rows}
    for number in range(20):
        assert ("was killed 3 times" in errors[number]) == (deaths.get(number, 0) >= 3)
    assert max(groups) == (5 if len(deaths) < 20 else 1)  # 5 as soon as it is known that the sessions are small


RUN = """
import sys
from test_many import SWINGS
from torchstickcal import calibrate_many
if __name__ == "__main__":
    calibrate_many(SWINGS, out=sys.argv[1], jobs=1)
"""


@KILLS
def test_when_everything_is_killed_the_same_call_goes_on(tmp_path: Path):
    (tmp_path / "run.py").write_text(RUN)
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, tmp_path / "run.py", tmp_path / "out"]
    manifest = tmp_path / "out" / "manifest.jsonl"
    with subprocess.Popen(command, stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": paths}) as parent:
        while not (manifest.exists() and manifest.read_bytes().count(b"\n") >= 1):
            assert parent.poll() is None
            time.sleep(0.01)
        parent.kill()
        parent.communicate(timeout=20)  # ends when every process that can write to the pipe has ended
    before = manifest.read_bytes()
    manifest.write_bytes(before + b'{"name": "swing 1')  # as if it had been killed while it wrote
    with ThreadPoolExecutor(1) as pool:
        calibrate_many(SWINGS, executor=pool, out=tmp_path / "out")
    after = manifest.read_bytes()
    assert after.startswith(before)
    names = [json.loads(line)["name"] for line in after.splitlines()]
    assert sorted(names) == sorted(SWINGS)
    left = {path.name for path in (tmp_path / "out" / "results").rglob("*") if path.name.startswith(".")}
    assert not left


@pytest.mark.parametrize("count", [3, 30])
def test_the_manifests_are_read_no_oftener_for_more_sessions(count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    reads: list[Path] = []

    def counted(folder: Path) -> dict[str, SessionRow]:
        reads.append(folder)
        return read_manifests(folder)

    for module in (many, tables):
        monkeypatch.setattr(module, "read_manifests", counted)
    with ThreadPoolExecutor(1) as pool:
        done = calibrate_many([tmp_path / str(number) for number in range(count)], executor=pool, out=tmp_path / "out")
    assert (len(done.rows), len(reads)) == (count, 2)


def test_a_manifest_is_written_by_one_run_at_a_time(tmp_path: Path):
    pytest.importorskip("fcntl")
    with open_manifest(tmp_path / "manifest.jsonl"), pytest.raises(CalibrationError, match="another run"):
        calibrate_many({"a": partial(swing, 0)}, out=tmp_path)


@pytest.mark.parametrize("line", ["nonsense", "[]", '{"name": "a"}', "null", '{"x": ' * 2000])
def test_a_damaged_manifest_is_refused(line: str, tmp_path: Path):
    (tmp_path / "manifest.jsonl").write_text(line + "\n")
    with pytest.raises(FileFormatError, match=r"manifest.jsonl, line 1"):
        calibrate_many({"a": partial(swing, 0)}, out=tmp_path)


def test_other_settings_need_another_folder(expected: tuple[Path, Any]):
    for more in ({"config": "stick_only"}, {"refine": ["focal"]}):
        with pytest.raises(CalibrationError, match="other settings"):
            calibrate_many(SWINGS, out=expected[0], jobs=1, **more)


def test_the_code_of_the_settings_tells_what_changes_the_files():
    def code(config: Any = "default", refine: Any = None, path: str = "a.npz", stick: Any = None, **writing: Any) -> str:
        write = _Writing(**{"config": "x", "files": ResultFiles(), "world": "camera", "units": None} | writing)
        source = Source("a", SessionFile(path, given=None if stick is None else Given(Stick(0, 1, stick))))
        return Settings(load_config(config), refine, None, write, None).code_of(source)

    others = [code("stick_only"), code(refine="auto"), code(stick=1.0), code(stick=1.1), code(world="floor")]
    others += [code(files=ResultFiles(("trc",))), code(files=ResultFiles(page=False))]
    assert len({code(), *others}) == 8
    assert code(path="b.npz") == code() == code({"extends": "default"})


# --- shards, memory, names ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shards", [2, 3, 5])
def test_shards_are_all_sessions_each_once(shards: int, tmp_path: Path, expected: tuple[Path, Any]):
    found: list[str] = []
    with ThreadPoolExecutor(1) as pool:
        for shard in range(shards, 0, -1):
            done = calibrate_many(SWINGS, executor=pool, out=tmp_path, shard=(shard, shards))
            found += [row.name for row in done.rows]
        assert sorted(found) == sorted(SWINGS)
        whole = calibrate_many(SWINGS, executor=Slowly(), out=tmp_path)  # nothing is left to do
    assert figures(whole.rows) == figures(expected[1].rows)
    assert (tmp_path / "sessions.csv").read_text().count("\n") == 4


def _takes(budget: Budget, bytes: int, order: Any) -> None:
    with budget.taking(bytes):
        order.put(bytes)


def test_a_large_session_waits_until_it_is_alone():
    budget, order = Budget(100), SPAWN.SimpleQueue()
    with budget.taking(30):
        large = SPAWN.Process(target=_takes, args=(budget, 80, order))
        large.start()
        large.join(0.5)
        assert order.empty()
    large.join(60)
    assert order.get() == 80
    with pytest.raises(CalibrationError, match="more memory"), budget.taking(101):
        pass
    with budget.taking(100):
        pass


def test_memory_is_refused_where_it_cannot_be_enough():
    need = needed_bytes(swing(0))
    with ThreadPoolExecutor(1) as pool:
        rows = [calibrate_many([swing(0)], executor=pool, memory_bytes=bytes).rows[0] for bytes in (need, need - 1)]
    assert [row.outcome for row in rows] == ["converged", "failed"]
    assert "more memory" in str(rows[1].error)
    with pytest.raises(CalibrationError, match="too little memory for the processes"):
        calibrate_many(SWINGS, memory_bytes=1_000_000, jobs=1)


def test_nothing_is_loaded_before_its_turn(tmp_path: Path):
    made: list[int] = []

    def sessions() -> Iterator[Observations]:
        for seed in range(600):
            made.append(seed)
            yield swing(0)

    found, total = sources_of(sessions())
    assert next(found).name == "000000"
    assert (made, total) == ([0], None)


@pytest.mark.parametrize(
    ("sessions", "message"),
    [
        ("one.npz", "not several sessions"),
        (swing(0), "not several sessions"),
        (3, "not several sessions"),
        ([1], "not a session"),
        ({"a": None}, "not a session"),
        ({"": "a.npz"}, "not a name"),
        ({3: "a.npz"}, "not a name"),
        ({"\ud800": "a.npz"}, "cannot be written"),
        (["a.npz", Path("a.npz")], "two sessions of one name"),
    ],
)
def test_what_is_no_session_is_refused(sessions: Any, message: str, tmp_path: Path):
    with pytest.raises(CalibrationError, match=message):
        calibrate_many(sessions, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"jobs": 0}, "no process"),
        ({"jobs": 10_000}, "more processes"),
        ({"jobs": 1, "executor": Slowly()}, "jobs or executor"),
        ({"shard": (0, 2)}, "no such shard"),
        ({"shard": (3, 2)}, "no such shard"),
        ({"config": "nothing"}, "nothing"),
        ({"write": lambda *_: None}, "cannot be sent"),
    ],
)
def test_arguments_without_sense_are_refused(more: dict[str, Any], message: str):
    with pytest.raises(CalibrationError, match=message):
        calibrate_many(SWINGS, **more)


@pytest.mark.parametrize(
    "names", [["a", "A/b", "a_b", "a b", "ü", "..", ".", "x" * 200, "x" * 201, "CON:", "a\nb", "a/", "/a"]]
)
def test_every_name_has_a_folder_of_its_own(names: list[str], tmp_path: Path):
    folders = [folder_of(name) for name in names]
    for folder in folders:
        (tmp_path / folder).mkdir()
        assert (tmp_path / folder).parent == tmp_path


def test_folders_and_lists_are_sessions(tmp_path: Path):
    folder = tmp_path / "all"
    folder.mkdir()
    for name in ("b10.npz", "b9.npz", ".hidden", "notes.md"):
        (folder / name).write_bytes(b"?")
    (tmp_path / "list.txt").write_bytes(b"\xef\xbb\xbf# some\nall/b9.npz\r\n\n/else/where.npz\n")
    assert list(session_files([folder])) == ["b9.npz", "b10.npz", "notes.md"]
    assert session_files([folder])["b9.npz"] == SessionFile(folder / "b9.npz")
    listed = session_files([tmp_path / "list.txt"], "npz")
    assert listed == {
        "all/b9.npz": SessionFile(folder / "b9.npz", "npz"),
        "/else/where.npz": SessionFile(Path("/else/where.npz"), "npz"),
    }
    assert list(session_files([folder, tmp_path / "list.txt"]))[2:] == [
        f"{folder.as_posix()}/notes.md",
        "all/b9.npz",
        "/else/where.npz",
    ]
    with pytest.raises(CalibrationError, match="two sessions of one name"):
        session_files([folder / "b9.npz", folder])
    with pytest.raises(FileNotFoundError):
        session_files([tmp_path / "nowhere"])
    with pytest.raises(CalibrationError, match="no sessions"):
        session_files([])


# --- the command -------------------------------------------------------------------------------------------------------------


def test_the_command_writes_what_calibrate_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "sessions"
    folder.mkdir()
    write_npz(folder / "one.npz", swing(1))
    (folder / "two.npz").write_bytes(b"?")
    options = ["--stick-length", "1.1", "--refine", "none"]
    command = ["calibrate-many", str(folder), "--out", str(tmp_path / "many"), "--jobs", "1", "--memory", "2.5GB", *options]
    assert main(command) == 1
    said = capsys.readouterr()
    assert "1 of 2 converged, 1 failed" in said.out
    assert said.err.startswith("failed: two.npz: FileFormatError")
    assert "\r" not in said.err
    assert main(["calibrate", str(folder / "one.npz"), "--out", str(tmp_path / "one"), *options]) == 0
    files = {path.name for path in (tmp_path / "one").iterdir()}
    assert {path.name for path in (tmp_path / "many" / "results" / "one.npz").iterdir()} == files
    same = [(at / "calibration.toml").read_bytes() for at in (tmp_path / "one", tmp_path / "many" / "results" / "one.npz")]
    assert same[0] == same[1]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--memory", "much"], "not a size"),
        (["--memory", "1MB"], "too little memory"),
        (["--shard", "1"], "not a shard"),
        (["--shard", "4/3"], "no such shard"),
        (["--jobs", "0"], "no process"),
        (["--stick-sigma", "x"], "invalid float"),
    ],
)
def test_wrong_options_are_one_line(more: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_npz(tmp_path / "one.npz", swing(1))
    try:
        status = main(["calibrate-many", str(tmp_path / "one.npz"), "--out", str(tmp_path / "out"), *more])
    except SystemExit as left:
        status = left.code
    error = capsys.readouterr().err
    assert status == 2
    assert message in error
    assert error.count("\n") == 1
