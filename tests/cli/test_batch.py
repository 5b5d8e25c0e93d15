"""A batch does each item once, reports what fails, and loses nothing when a worker is killed or the run is stopped."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from importlib import resources
from pathlib import Path
from typing import Any

import locket
import psutil
import pytest

from pansplat import pipeline
from pansplat.cli import batch, run
from pansplat.cli.batch import REPORT_NAME, Batch, fingerprint_work, list_items, process_item
from pansplat.model.pansplat import PanSplat
from pansplat.networks.weights import pack_weights, save_weights
from pansplat.prediction_options import PredictOptions

HEIGHT = 64
SPHERE = PredictOptions("sphere", height=HEIGHT, refine_steps=0)


@pytest.fixture
def rooms(tmp_path: Path, write_pair: Callable[..., Path]) -> Path:
    """A folder with three pairs of 64 rows."""
    for index in range(3):
        write_pair(tmp_path / "rooms" / f"room{index}", height=HEIGHT, seed=index)
    return tmp_path / "rooms"


def process(folder: Path, out: Path, do: str, **options: Any) -> dict[str, Any]:
    """The line of the report of a folder, which must not fail."""
    command = Batch(folder, out, do=do, **{"prediction": SPHERE, **options})
    line = process_item((folder.name, folder), command, fingerprint_work(command.prediction))
    assert line["error"] is None
    return line


def list_outputs(out: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of all files of a batch, but the report and the lock."""
    files = [path for path in out.rglob("*") if path.is_file() and path.name not in (REPORT_NAME, ".lock")]
    return {path.relative_to(out).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}


def read_report(out: Path) -> dict[str, Any]:
    """The lines of the report by item."""
    lines = [json.loads(line) for line in (out / REPORT_NAME).read_text().splitlines()]
    assert len({line["item"] for line in lines}) == len(lines)
    return {line["item"]: line for line in lines}


def test_the_items_are_the_folders_with_panoramas(rooms: Path, write_pair: Callable[..., Path]) -> None:
    write_pair(rooms / "house" / "kitchen")
    (rooms / "empty").mkdir()
    assert list(list_items(rooms)) == ["house/kitchen", "room0", "room1", "room2"]
    assert list_items(rooms / "room1") == {"room1": rooms / "room1"}


def test_only_what_is_not_up_to_date_is_made_and_takes_the_place_of_what_was(rooms, tmp_path, write_pair):
    out, room = tmp_path / "out", rooms / "room0"
    first = process(room, out, "predict,export", format="spz")
    assert first["status"] == "done" and sorted(list_outputs(out)) == sorted(first["outputs"]) != []
    predicted, exported = (pipeline.load(out / name) for name in first["outputs"])
    assert len(predicted.gaussians) == 2 * 16 * 32 and not predicted.joint
    assert exported.joint and 0.4 < len(exported.gaussians) / len(predicted.gaussians) < 0.9, "each surface once"
    files = list_outputs(out)
    assert process(room, out, "predict,export", format="spz")["status"] == "skipped" and list_outputs(out) == files
    (out / "room0" / "notes.txt").write_text("of the user")
    other_format = process(room, out, "predict,export", format="splat")
    assert other_format["status"] == "done" and other_format["outputs"][0] == first["outputs"][0]
    assert {name: list_outputs(out)[name] for name in files} == files, "another format stays"
    write_pair(room, height=HEIGHT, seed=9)
    for prediction in (SPHERE, PredictOptions("sphere", height=80, refine_steps=0)):
        again = process(room, out, "predict,export", format="spz", prediction=prediction)
        kept = {*again["outputs"], other_format["outputs"][1], "room0/notes.txt"}
        assert again["status"] == "done" and set(list_outputs(out)) == kept, "what it replaces goes"


@pytest.mark.filterwarnings("ignore")  # as in a worker
def test_a_note_on_the_folder_is_reported_once(rooms: Path, tmp_path: Path) -> None:
    file = rooms / "room0" / "poses.json"
    content = json.loads(file.read_text())
    name, entry = next(iter(content["poses"].items()))
    pose = entry["cam2world"] if isinstance(entry, dict) else entry
    content["poses"][name] = {"cam2world": pose, "depth": "no.png"}
    file.write_text(json.dumps(content))
    (note,) = process(rooms / "room0", tmp_path / "out", "predict,export", format="spz")["notes"]
    assert "no.png" in note


def test_a_changed_note_of_a_hot_spot_makes_the_page_anew(tmp_path: Path, write_tour: Callable) -> None:
    house, out = write_tour(tmp_path / "house", 4, height=HEIGHT), tmp_path / "out"
    for text in ("an old stove", "a new stove"):
        (house / "links.json").write_text(json.dumps({"p0.png": {"notes": [{"yaw": 0.1, "pitch": 0, "text": text}]}}))
        line = process(house, out, "export")
        assert line["status"] == "done" and [*list_outputs(out)] == line["outputs"] and len(line["outputs"]) == 1
        page = (out / line["outputs"][0]).read_text()
        assert text in page and len(json.loads(page.split("const HEADER = ")[1].split(";\n")[0])["edges"]) == 3


def test_a_tour_and_each_pair_beside_it_have_one_file_of_each_step(tmp_path, write_tour) -> None:
    house, out = write_tour(tmp_path / "house", 7, height=HEIGHT), tmp_path / "out"
    pairs = [{"context": [f"p{a}.png", f"p{a + 1}.png"]} for a in (0, 1, 3, 5)]
    (house / "pairs.json").write_text(json.dumps({"pairs": pairs}))
    line = process(house, out, "predict,export", format="splat")
    assert len(line["outputs"]) == 6
    views = [len(pipeline.load(out / name).cam2world) for name in line["outputs"][::2]]
    assert sorted(views) == [2, 2, 3]
    process(house, out, "predict", prediction=PredictOptions("sphere", height=80))
    assert len(list_outputs(out)) == 6


def test_other_pairs_and_approximate_places_have_outputs_of_other_names(tmp_path, write_tour) -> None:
    house, seen = write_tour(tmp_path / "house", 4, height=HEIGHT), set()
    poses = json.loads((house / "poses.json").read_text())
    del poses["poses"]["p3.png"]
    place = {"between": ["p0.png", "p3.png"], "place": [0, 1, 0]}
    for number, (middle, places) in enumerate(
        ((1, []), (1, [place]), (1, [place | {"place": [0, 2, 0]}]), (1, [place | {"by": ["p1.png"]}]), (0, []))
    ):
        pairs = [{"context": ["p0.png", "p1.png"]}, {"context": [f"p{middle}.png", "p2.png"]}]
        (house / "pairs.json").write_text(json.dumps({"pairs": pairs}))
        (house / "poses.json").write_text(json.dumps(poses | {"estimate": {"approximate": places}}))
        with pytest.warns(UserWarning, match=r"no pose of p3\.png"):
            seen |= set(Batch(tmp_path, tmp_path, do="export", prediction=SPHERE).list_commands(house))
        assert len(seen) > number


def test_the_fingerprint_is_that_of_the_program_of_pages(tmp_path: Path, monkeypatch) -> None:
    folders = {name: shutil.copytree(str(resources.files(name)), tmp_path / name) for name in batch._PROGRAM}
    monkeypatch.setattr(resources, "files", folders.__getitem__)
    fingerprint_work.cache_clear()
    seen = {fingerprint_work(SPHERE)}
    for suffix in ("js", "html", "css", "glsl", "vert", "frag"):
        for file in [file for folder in folders.values() for file in folder.glob(f"*.{suffix}")][:1]:
            file.write_text(file.read_text() + " ")
        fingerprint_work.cache_clear()
        seen.add(fingerprint_work(SPHERE))
    assert len(seen) == 7


def test_files_of_weights_have_whole_paths_on_workers(rooms: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    batches: list[Batch] = []
    monkeypatch.setattr(batch, "fingerprint_work", lambda options: "1")
    monkeypatch.setattr(Batch, "_run_items", lambda self, items: batches.append(self) or Counter())
    assert run(["batch", "rooms", "-o", "out", "--model", "a.safetensors", "--depth-network", "b.onnx"]) == 0
    assert batches[0].prediction.model == str(tmp_path / "a.safetensors")
    assert batches[0].prediction.depth_network == tmp_path / "b.onnx"


def test_the_export_of_a_refined_scene_is_refined(rooms: Path, tmp_path: Path) -> None:
    steps = {
        do: Batch(rooms, tmp_path, do=do).list_commands(rooms / "room0") for do in ("export", "predict,refine,export")
    }
    limits = [
        {name.split("-")[0]: getattr(e.prediction, "options", e.prediction).refine_steps for name, e in each.items()}
        for each in steps.values()
    ]
    assert limits == [{"export": 0}, {"predict": 0, "refine": None, "export": None}]


def test_a_worker_with_another_predictor_is_refused(rooms: Path, tmp_path: Path) -> None:
    line = process_item(("room0", rooms / "room0"), Batch(rooms, tmp_path / "out", prediction=SPHERE), "2")
    assert line["status"] == "failed" and "same version of pansplat" in line["error"]
    assert not list_outputs(tmp_path / "out")


def test_files_that_a_killed_worker_left_are_removed_and_others_are_kept(rooms, tmp_path) -> None:
    out = tmp_path / "out"
    (name,) = process(rooms / "room0", out, "predict")["outputs"]
    stem = Path(name).stem
    for left in (f".{stem}.0123abcd.ply", f".{stem[:48]}.0123abcd.html", ".gitignore"):
        (out / "room0" / left).touch()
    process(rooms / "room0", out, "predict")
    assert set(list_outputs(out)) == {name, "room0/.gitignore"}


def test_without_dask_the_message_names_the_command_that_installs_it(rooms, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run(["batch", str(rooms), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.endswith("run pip install 'pansplat[cluster]'\n")
    assert not (tmp_path / "out").exists()


def test_two_batches_do_not_share_a_folder(rooms: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with locket.lock_file(str(tmp_path / ".lock")):
        assert run(["batch", str(rooms), "--out", str(tmp_path), "--model", "sweep"]) == 2
    assert "got one that another batch writes to" in capsys.readouterr().err


def when_predicted(out: Path, item: str, act: Callable[[], object]) -> threading.Thread:
    """Call a function as soon as the prediction of an item is written and its refinement runs."""

    def wait() -> None:
        while not list((out / item).glob("predict-*")):
            time.sleep(0.02)
        act()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def interrupt_until(stopped: threading.Event) -> None:
    """Send SIGINT to this process, again if Python loses it: an exception in a destructor is ignored."""
    while not stopped.is_set():
        os.kill(os.getpid(), signal.SIGINT)
        stopped.wait(20)


def kill_the_worker_of(cluster: Any, item: str) -> None:
    """Kill the worker process that runs the task of an item with -9."""
    for address, state in list(cluster.scheduler.workers.items()):
        if any(task.key.endswith(item) for task in state.processing):
            (pid,) = [nanny.pid for nanny in cluster.workers.values() if nanny.worker_address == address]
            os.kill(pid, signal.SIGKILL)


def is_alive(pid: int) -> bool:
    """Whether a process exists and has not ended."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.exhaustive
@pytest.mark.slow
def test_two_workers_do_each_item_once_though_a_worker_is_killed_an_item_is_bad_and_a_run_is_stopped(
    rooms: Path, tmp_path: Path, small_config: Any, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    (rooms / "broken").mkdir()
    (rooms / "broken" / "poses.json").write_text("x")
    weights = tmp_path / "small.safetensors"
    save_weights(weights, pack_weights("pansplat", small_config, PanSplat(small_config).state_dict(), compat="fixed"))
    out, options = tmp_path / "out", ["--model", str(weights), "--height", str(HEIGHT), "--do", "predict,refine"]
    command = ["batch", str(rooms), "--out", str(out), *options, "--refine", "1"]
    with pytest.raises(KeyboardInterrupt), batch.start_workers(2) as cluster:
        # In this process, the first one would change the threads of the kernels; the second one makes workers slow.
        assert not {"NUMBA_NUM_THREADS", "MALLOC_TRIM_THRESHOLD_"} & os.environ.keys()
        pids = [nanny.pid for nanny in cluster.workers.values()]
        with monkeypatch.context() as patch:  # the workers of this test serve the command
            patch.setattr(batch, "start_workers", lambda workers: nullcontext(cluster))
            killer = when_predicted(out, "room1", lambda: kill_the_worker_of(cluster, "room1"))
            assert run(command) == 1
        killer.join()
        assert [is_alive(pid) for pid in pids].count(False) == 1
        report = read_report(out)
        assert {name: line["status"] for name, line in report.items()} == {
            "broken": "failed", "room0": "done", "room1": "done", "room2": "done",
        }  # fmt: skip
        assert "poses.json" in report["broken"]["error"]
        files = list_outputs(out)
        assert sorted(files) == sorted(name for line in report.values() for name in line["outputs"])
        assert len(files) == 6 and all(len(pipeline.load(out / name).gaussians) for name in files)

        with_scheduler = [*command, "--scheduler", cluster.scheduler_address]
        assert run(with_scheduler) == 1
        assert [read_report(out)[f"room{index}"]["status"] for index in range(3)] == ["skipped"] * 3
        assert list_outputs(out) == files

        other = tmp_path / "stopped"
        with_scheduler[3], with_scheduler[-3] = str(other), "600"
        stopped = threading.Event()
        when_predicted(other, "room0", lambda: interrupt_until(stopped))
        assert run(with_scheduler) == 130
        stopped.set()
        pids = [nanny.pid for nanny in cluster.workers.values()]
        began = time.perf_counter()
        raise KeyboardInterrupt
    assert time.perf_counter() - began < 550 and not any(is_alive(pid) for pid in pids)
    for name in list_items(rooms):
        batch._remove_unfinished(other / name)
    complete = list_outputs(other)  # a refinement may end early
    assert complete and all(len(pipeline.load(other / name).gaussians) for name in complete)
    printed, errors = capfd.readouterr()
    assert "4 items: 3 done, 0 already there, 1 failed" in printed
    assert "4 items: 0 done, 3 already there, 1 failed" in printed
    assert "workers: 2, of at most " in errors and "Traceback" not in errors
    assert errors.count("note: broken: ") >= 2
    assert errors.splitlines()[-1] == "interrupted: no incomplete file is left behind"
