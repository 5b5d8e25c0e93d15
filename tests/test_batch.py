"""A batch does each item once, reports what fails, and loses nothing when a worker is killed or the run is stopped."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from pansplat import batch, pipeline
from pansplat.batch import BatchOptions, Item, list_items, process_item
from pansplat.cli import run
from pansplat.cli.batch import Batch, _write_report
from pansplat.errors import InputError
from pansplat.export import page as page_module
from pansplat.model.pansplat import PanSplat
from pansplat.model.weights import pack_weights, save_weights
from pansplat.prediction_options import PredictOptions

HEIGHT = 64
SPHERE = PredictOptions("sphere", height=HEIGHT)


ignores_notes = pytest.mark.filterwarnings("ignore::pansplat.errors.InputWarning")  # as workers do


@pytest.fixture
def sphere(sphere_predictor: type, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """`--model sphere` in this process."""
    monkeypatch.setitem(pipeline._MODELS, "sphere", sphere_predictor)
    batch.load_predictor.cache_clear()
    yield
    batch.load_predictor.cache_clear()


@pytest.fixture
def rooms(tmp_path: Path, write_pair: Callable[..., Path]) -> Path:
    """A folder with three pairs of 64 rows."""
    for index in range(3):
        write_pair(tmp_path / "rooms" / f"room{index}", height=HEIGHT, seed=index)
    return tmp_path / "rooms"


def list_outputs(out: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of all files of a batch, but the report and the lock."""
    files = [path for path in out.rglob("*") if path.is_file() and path.name not in (batch.REPORT_NAME, ".lock")]
    return {path.relative_to(out).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}


def read_report(out: Path) -> dict[str, Any]:
    """The lines of the report by item."""
    lines = [json.loads(line) for line in (out / batch.REPORT_NAME).read_text().splitlines()]
    assert len({line["item"] for line in lines}) == len(lines)
    return {line["item"]: line for line in lines}


def test_the_items_of_a_folder_are_its_folders_with_panoramas(rooms: Path, write_pair: Callable[..., Path]) -> None:
    write_pair(rooms / "house" / "kitchen")
    (rooms / "empty").mkdir()
    assert [item.name for item in list_items(rooms)] == ["house/kitchen", "room0", "room1", "room2"]
    assert [item.name for item in list_items(rooms / "room1")] == ["room1"]


def test_a_manifest_names_folders_relative_to_itself(rooms: Path) -> None:
    entries = ["room0", {"path": "room1", "name": "kitchen", "pair": "left-right", "near": 0.2, "far": 5}]
    (rooms / "all.json").write_text(json.dumps({"items": entries}))
    first, second = list_items(rooms / "all.json")
    assert first == Item("room0", rooms / "room0")
    assert second == Item("kitchen", rooms / "room1", "left-right", None, 0.2, 5.0)


def test_only_steps_whose_inputs_changed_are_done_again(
    rooms: Path, tmp_path: Path, sphere: None, write_pair: Callable[..., Path]
) -> None:
    out, item = tmp_path / "out", Item("room0", rooms / "room0")

    def process(*steps: str, height: int = HEIGHT, suffix: str = ".spz") -> batch.ItemReport:
        return process_item(item, BatchOptions(steps, PredictOptions("sphere", height=height), suffix=suffix), "1", out)

    first = process("predict", "export")
    assert (first.status, len(first.outputs)) == ("done", 2) and first.error is None
    predicted, exported = (pipeline.load(out / name) for name in first.outputs)
    assert len(predicted.gaussians) == 2 * HEIGHT * 2 * HEIGHT and not predicted.joint
    assert exported.joint and 0.4 < len(exported.gaussians) / len(predicted.gaussians) < 0.9, "each surface once"
    files = list_outputs(out)
    assert process("predict", "export").status == "skipped" and list_outputs(out) == files

    other_format = process("predict", "export", suffix=".splat")
    assert other_format.status == "done" and other_format.outputs[0] == first.outputs[0]
    assert {name: list_outputs(out)[name] for name in files} == files

    assert not set(process("predict", "export", height=80).outputs) & set(first.outputs)
    write_pair(rooms / "room0", height=HEIGHT, seed=9)
    assert not set(process("predict", "export").outputs) & set(first.outputs)


def test_a_tour_has_a_file_for_each_scene_and_one_page(
    tmp_path: Path, sphere: None, write_tour: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_module, "_POSTER_SIZE", (18, 32))
    house, out = write_tour(tmp_path / "house", 4, height=HEIGHT), tmp_path / "out"

    def process(*steps: str, **options: Any) -> batch.ItemReport:
        return process_item(Item("house", house), BatchOptions(steps, SPHERE, **options), "1", out)

    report = process("predict", "export")
    assert report.error is None and report.status == "done"
    graph, *predictions, page = report.outputs
    assert len(predictions) == 2 and page.endswith("-house tour.html") and graph.endswith("-house tour.json")
    assert len(json.loads((out / page).read_text().split("const HEADER = ")[1].split(";\n")[0])["edges"]) == 3
    with monkeypatch.context() as patch:
        patch.setattr(batch, "connect", None)  # the file of the graph is used
        assert process("predict", "export").status == "skipped"
    whole = process("export", suffix=".splat")  # nothing is predicted into files
    assert whole.error is None and len(whole.outputs) == 2
    assert (out / whole.outputs[1]).stat().st_size < 0.9 * 32 * 4 * HEIGHT * 2 * HEIGHT, "each surface once"
    one = process_item(Item("pair", house, "p1-p2"), BatchOptions(("predict",), SPHERE), "1", out)
    assert one.error is None and len(one.outputs) == 1


@pytest.fixture
def parted_house(tmp_path: Path, write_tour: Callable[..., Path]) -> Path:
    """A folder of three panoramas; the last one has no pose."""
    house = write_tour(tmp_path / "house", 3, height=HEIGHT)
    content = json.loads((house / "poses.json").read_text())
    del content["poses"]["p2.png"]
    (house / "poses.json").write_text(json.dumps(content))
    (house / "pairs.json").unlink()
    return house


@ignores_notes
def test_single_views_of_a_tour_are_predicted_by_default_if_the_model_needs_two(
    parted_house: Path, tmp_path: Path, sphere: None, sphere_predictor: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sphere_predictor, "min_views", 2, raising=False)
    of_single_views = sphere_predictor("2")
    of_single_views.min_views = 1
    monkeypatch.setitem(pipeline._MODELS, "default", lambda: of_single_views)
    options, item = BatchOptions(("predict",), SPHERE), Item("house", parted_house)
    report = process_item(item, options, "1", tmp_path / "out")
    assert report.error is None and len(report.outputs) == 3 and of_single_views.calls == 1
    assert sum("single view is predicted by default" in note for note in report.notes) == 1
    assert process_item(item, options, "1", tmp_path / "out").status == "skipped"


@ignores_notes
def test_predictions_depend_on_titles_start_views_and_of_single_views_the_camera_height(
    parted_house: Path, tmp_path: Path, sphere: None
) -> None:
    def process(camera_height: float = 1.5, **entry: Any) -> dict[str, str]:
        (parted_house / "links.json").write_text(json.dumps({"p0.png": entry, "p2.png": entry}))
        options = BatchOptions(("predict",), SPHERE, camera_height=camera_height)
        report = process_item(Item("house", parted_house), options, "1", tmp_path / "out")
        assert report.error is None
        return {name.split("-", 2)[2]: name for name in report.outputs if "predict-" in name}

    first, tall, titled, turned = process(), process(3.0), process(title="hall"), process(start=[1.0, 0.1])
    pair, single = sorted(first, key=len, reverse=True)
    assert tall[pair] == first[pair] and len({files[pair] for files in (first, titled, turned)}) == 3
    assert len({files[single] for files in (first, tall, titled, turned)}) == 4
    scenes = [pipeline.load(tmp_path / "out" / files[single]) for files in (first, tall, titled, turned)]
    assert scenes[1].gaussians.means.abs().max() > 1.9 * scenes[0].gaussians.means.abs().max()
    assert scenes[2].names == ("hall",) and scenes[3].starts == ((1.0, 0.1),)


def test_the_command_passes_the_camera_height_to_its_items() -> None:
    assert Batch(Path("rooms"), Path("out"), camera_height=2.0)._make_options().camera_height == 2.0


@ignores_notes
def test_single_views_are_not_refined_with_one_note(
    parted_house: Path, tmp_path: Path, sphere: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    refined = []

    def refine(scene: Any, views: Any, path: Path, **options: Any) -> None:
        refined.append(len(views.images))
        pipeline.save(scene, path)

    monkeypatch.setattr(pipeline, "refine_to_file", refine)
    for steps, count in ((("predict", "refine", "export"), 5), (("refine",), 3)):
        options = BatchOptions(steps, SPHERE, suffix=".splat")
        report = process_item(Item("house", parted_house), options, "1", tmp_path / steps[0])
        assert report.error is None and len(report.outputs) == count and refined.pop() == 2 and not refined
        assert sum("a single view is not refined" in note for note in report.notes) == 1


def test_a_worker_with_another_predictor_is_refused(rooms: Path, tmp_path: Path, sphere: None) -> None:
    options = BatchOptions(prediction=SPHERE)
    report = process_item(Item("room0", rooms / "room0"), options, "2", tmp_path / "out")
    assert report.status == "failed" and "same version of pansplat" in str(report.error)
    assert not list_outputs(tmp_path / "out")


def test_files_that_a_killed_worker_left_are_removed_and_others_are_kept(
    rooms: Path, tmp_path: Path, sphere: None
) -> None:
    out, options = tmp_path / "out", BatchOptions(prediction=SPHERE)
    (name,) = process_item(Item("room0", rooms / "room0"), options, "1", out).outputs
    stem = Path(name).stem
    for left in (f".{stem}.0123abcd.ply", f".{stem[:48]}.0123abcd.html", ".gitignore"):
        (out / "room0" / left).touch()
    process_item(Item("room0", rooms / "room0"), options, "1", out)
    assert set(list_outputs(out)) == {name, "room0/.gitignore"}


def test_on_a_full_disk_no_half_file_is_left_and_the_item_is_done_later(
    rooms: Path, tmp_path: Path, sphere: None
) -> None:
    resource = pytest.importorskip("resource")
    out, options, item = tmp_path / "out", BatchOptions(prediction=SPHERE), Item("room0", rooms / "room0")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))  # of a file; the error is that of a full disk
    try:
        report = process_item(item, options, "1", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert report.status == "failed" and not list_outputs(out)
    assert "free disk space, got 'File too large'" in str(report.error)
    assert process_item(item, options, "1", out).status == "done" and len(list_outputs(out)) == 1


def test_without_space_for_its_file_an_item_is_not_predicted(
    rooms: Path, tmp_path: Path, sphere: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=600_000))
    options = BatchOptions(prediction=SPHERE)
    report = process_item(Item("room0", rooms / "room0"), options, "1", tmp_path / "out")
    assert report.status == "failed" and "needed at least 0.7 MB of free disk space" in str(report.error)
    assert "got 0.6 MB" in str(report.error) and batch.load_predictor(SPHERE).calls == 0


def test_lines_of_the_report_wait_while_the_disk_is_full(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    limits, path = resource.getrlimit(resource.RLIMIT_FSIZE), tmp_path / "report.jsonl"

    def end_items(last: int) -> Iterator[batch.ItemReport]:
        for index in range(4):
            full = index < last
            resource.setrlimit(resource.RLIMIT_FSIZE, (10 if full else limits[0], limits[1]))
            yield batch.ItemReport(f"room{index}", "done", 1.0)

    try:
        count, problem = _write_report(end_items(4), 4, path)
        assert count["done"] == 4 and problem is not None and "report.jsonl: needed free disk space" in problem
        assert _write_report(end_items(3), 4, path) == (count, None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(read_report(tmp_path)) == [f"room{index}" for index in range(4)]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_batch_without_space_for_its_report_finishes_its_items_and_fails(
    rooms: Path, tmp_path: Path, sphere: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options, out = BatchOptions(prediction=SPHERE), tmp_path / "out"
    (out / batch.REPORT_NAME).parent.mkdir()
    (out / batch.REPORT_NAME).symlink_to("/dev/full")
    monkeypatch.setattr(batch, "start_workers", lambda *_: nullcontext())
    monkeypatch.setattr(
        batch, "run_items", lambda _, items, *__: (process_item(item, options, "1", out) for item in items)
    )
    assert run(["batch", str(rooms), "--out", str(out), "--model", "sphere"]) == 1
    assert len(list_outputs(out)) == len(batch.list_items(rooms))
    assert "report.jsonl: needed free disk space for the report" in capsys.readouterr().err


def test_without_dask_the_message_names_the_command_that_installs_it(
    rooms: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run(["batch", str(rooms), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.endswith("run pip install 'pansplat[cluster]'\n")
    assert not (tmp_path / "out").exists()


def test_two_batches_do_not_share_a_folder(tmp_path: Path) -> None:
    with (
        batch.lock_folder(tmp_path / "out"),
        pytest.raises(InputError, match="another batch"),
        batch.lock_folder(tmp_path / "out"),
    ):
        pass


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
    with pytest.raises(KeyboardInterrupt), batch.start_workers(2, 4 << 30) as cluster:
        # In this process, the first one would change the threads of the kernels; the second one makes workers slow.
        assert not {"NUMBA_NUM_THREADS", "MALLOC_TRIM_THRESHOLD_"} & os.environ.keys()
        pids = [nanny.pid for nanny in cluster.workers.values()]
        with monkeypatch.context() as patch:  # the workers of this test serve the command
            patch.setattr(batch, "start_workers", lambda workers, memory: nullcontext(cluster))
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
    batch.remove_unfinished(list_items(rooms), other)
    complete = list_outputs(other)  # a refinement may end early
    assert complete and all(len(pipeline.load(other / name).gaussians) for name in complete)
    printed, errors = capfd.readouterr()
    assert "4 items: 3 done, 0 already there, 1 failed" in printed
    assert "4 items: 0 done, 3 already there, 1 failed" in printed
    assert "workers: 2, of at most 4.0 GiB each" in errors and "Traceback" not in errors
    assert errors.count("note: broken: ") >= 2
    assert errors.splitlines()[-1] == "interrupted: no incomplete file is left behind"
