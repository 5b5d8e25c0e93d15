"""Fixtures for all tests."""

import contextlib
import importlib.util
import itertools
import json
import os
import re
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from annotation_checks import restart_checks
from hypothesis import HealthCheck, settings
from jaxtyping import config, install_import_hook
from panorama_formats import write_posed
from torch import Tensor

from pansplat.system.allocator import keep_freed_memory

keep_freed_memory()  # as the commands
# One thread per pytest-xdist worker and its child processes: workers must not compete for cores.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)

# A shell starts programs in the background with SIGINT ignored, and child processes inherit that; some tests send it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Triton reads this variable at its first import, and torch may import it. Its LLVM must be loaded before Mesa's.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")
with contextlib.suppress(ImportError):
    import triton  # noqa: F401

# Generated examples may take any time, because machines differ. They are the same in each run;
# `--hypothesis-profile random` generates others.
settings.register_profile("repeatable", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("random", settings.get_profile("repeatable"), derandomize=False)
settings.load_profile("repeatable")

_SHARED = Path(__file__).resolve().parents[2] / "shared"

# All tests check the annotated shapes and types of these packages, which nothing has imported yet.
_CHECKED = ("geometry", "gaussians", "model", "networks", "rendering", "refinement", "predictor")
_CHECKED += ("evaluation", "pipeline")
install_import_hook([f"pansplat.{name}" for name in _CHECKED], "annotation_checks.check_types")

pytest_plugins = ["panorama_fixtures"]  # imported after the hook


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests of the marker `exhaustive` unless -m names it."""
    if re.search(r"(?<!not )\bexhaustive\b", config.option.markexpr):
        return
    config.hook.pytest_deselected(items=[item for item in items if item.get_closest_marker("exhaustive")])
    items[:] = [item for item in items if not item.get_closest_marker("exhaustive")]


@pytest.fixture
def refinement_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count 0.01 s for each reading of the refinement's clock, so that its steps do not depend on the machine."""
    ticks = itertools.count(step=0.01)
    monkeypatch.setattr("pansplat.refinement.refinement.time", SimpleNamespace(perf_counter=lambda: next(ticks)))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder ../shared of fixtures and data; if it is missing, the test fails in CI and is skipped elsewhere."""
    if not _SHARED.is_dir():
        if os.environ.get("CI"):
            pytest.fail("CI needs the folder ../shared")
        pytest.skip("needs the folder ../shared")
    return _SHARED


@pytest.fixture(scope="session")
def recipe(shared: Path) -> Callable[[str], dict[str, torch.Tensor]]:
    """Make weights with official names by the golden recipe, for the name of a key list such as "pansplat-512"."""
    source = importlib.util.spec_from_file_location("make_weights", shared / "golden" / "make_weights.py")
    assert source is not None and source.loader is not None
    module = importlib.util.module_from_spec(source)
    source.loader.exec_module(module)

    def make(keys: str) -> dict[str, torch.Tensor]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # the recipe does not close its file
            arrays = module.state_dict(shared / "golden" / f"state_dict_{keys}.tsv")
        return {name: torch.from_numpy(array) for name, array in arrays.items()}

    return make


@pytest.fixture(scope="session")
def randomize() -> Callable[[torch.nn.Module], torch.nn.Module]:
    """Fill a network with float64 noise, so that no layer is an identity or zero; in eval mode."""

    def fill(module: torch.nn.Module) -> torch.nn.Module:
        generator = torch.Generator().manual_seed(5)
        module = module.double().eval()
        with torch.no_grad():
            for parameter in module.parameters():
                fan_in = max(1, parameter[0].numel())
                parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64) / fan_in**0.5)
        return module

    return fill


@pytest.fixture(scope="session")
def recipe_weights(recipe: Callable[[str], dict[str, torch.Tensor]]) -> dict[str, torch.Tensor]:
    """The 993 tensors of the official PanSplat without the prefix "encoder."; 200 MB, read-only."""
    return recipe("pansplat-512")


@pytest.fixture(scope="session")
def as_lightning() -> Callable[[dict[str, torch.Tensor]], dict[str, object]]:
    """Wrap tensors in a Lightning checkpoint like those of the official training."""

    def wrap(tensors: dict[str, torch.Tensor]) -> dict[str, object]:
        return {
            "epoch": 4,
            "global_step": 9000,
            "pytorch-lightning_version": "2.2.0",
            "state_dict": {f"encoder.{name}": tensor for name, tensor in tensors.items()},
            "loops": {"fit_loop": {"state_dict": {}}},
            "optimizer_states": [{"state": {0: {"step": torch.tensor(9000.0)}}, "param_groups": []}],
        }

    return wrap


@pytest.fixture(scope="session")
def golden(shared: Path) -> Callable[[str], dict[str, torch.Tensor]]:
    """Load outputs of the official code, such as "pansplat_64x128_fp32attn" or "units"."""

    def load(name: str) -> dict[str, torch.Tensor]:
        return safetensors.torch.load_file(shared / "golden" / f"{name}.safetensors")

    return load


@pytest.fixture(autouse=True)
def _restored_signal_handlers() -> Iterator[None]:
    """Restore the handlers after a test: the end of a command ignores signals, and child processes inherit that."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def _unchanged_threads() -> Iterator[None]:
    """No test changes the number of torch's threads: two on a busy core make later tests ten times slower."""
    threads = torch.get_num_threads()
    yield
    assert torch.get_num_threads() == threads


@pytest.fixture
def run_with_threads() -> Iterator[Callable[[Callable[[], Any]], list[Any]]]:
    """The results of a function with one thread of torch, two, three and five."""
    before = torch.get_num_threads()
    yield lambda function: [torch.set_num_threads(count) or function() for count in (1, 2, 3, 5)]
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def _restarted_checks() -> None:
    """Check the annotations of each function in each test."""
    restart_checks()


@pytest.fixture
def full_disk() -> Callable[[int], contextlib.AbstractContextManager[None]]:
    """A block in which files end after a number of bytes; the error is that of a full disk."""
    resource = pytest.importorskip("resource")

    @contextlib.contextmanager
    def limit(count: int) -> Iterator[None]:
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (count, limits[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    return limit


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Disable the run-time checks of annotations, for tests of error messages."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)


class SpherePredictor:
    """One Gaussian per pixel, on a sphere of 2 m around each camera; counts its calls."""

    def __init__(self, fingerprint: str = "1") -> None:
        self.name, self.fingerprint, self.calls = "sphere", fingerprint, 0

    def __call__(self, images: Tensor, cam2world: Tensor, near: float, far: float, *, masks=None) -> Any:
        from synthetic_scenes import make_balls  # after the import hook

        from pansplat.geometry.equirect import pixel_directions

        self.calls += 1
        view, _, height, width = images.shape
        directions = pixel_directions(height, width, dtype=torch.float64).reshape(-1, 3)
        means = torch.cat([2 * directions @ p[:3, :3].T + p[:3, 3] for p in cam2world.double()])
        color, views = images.flatten(2).transpose(1, 2).reshape(-1, 3), torch.arange(view)
        return make_balls(means, 6.4 / height, color=color, views=views.repeat_interleave(len(directions)))


def _write_pair(folder: Path, *, height: int = 16, seed: int = 0) -> Path:
    pixels = np.random.default_rng(seed).integers(0, 255, (2, height, 2 * height, 3), dtype=np.uint8)
    return write_posed(folder, {"left.png": pixels[0], "right.png": pixels[1]}, (0, 0.5))


@pytest.fixture(scope="session")
def write_room() -> Callable[..., Path]:
    """Write a pair of noise panoramas, a.png and b.png, and perhaps a target c.png halfway between them."""

    def write(folder: Path, *, height: int = 64, baseline: float = 1.0, target: bool = True) -> Path:
        pixels = np.random.default_rng(0).integers(0, 255, (3, height, 2 * height, 3), dtype=np.uint8)
        names = ["a.png", "b.png", "c.png"]
        write_posed(folder, dict(zip(names, pixels, strict=True)), (0, baseline, baseline / 2))
        case = {"context": names[:2]} | ({"target": "c.png"} if target else {})
        (folder / "pairs.json").write_text(json.dumps({"pairs": [case]}))
        return folder

    return write


def _write_tour(folder: Path, count: int = 3, *, height: int = 16) -> Path:
    names = [f"p{index}.png" for index in range(count)]
    halves = np.random.default_rng(0).integers(0, 255, (count + 1, height, height, 3), dtype=np.uint8)
    pictures = {
        name: np.concatenate((halves[index + index % 2], halves[index + 1 - index % 2]), axis=1)
        for index, name in enumerate(names)
    }
    write_posed(folder, pictures, 0.5 * np.arange(count), axis=2)
    pairs = [{"context": [a, b]} for a, b in itertools.pairwise(names)]
    (folder / "pairs.json").write_text(json.dumps({"pairs": pairs}))
    return folder


@pytest.fixture(scope="session")
def write_tour() -> Callable[..., Path]:
    """Write noise panoramas in a row, 0.5 m apart; each and the next one are a pair, and have a half in common."""
    return _write_tour


@pytest.fixture(scope="session")
def sphere_predictor() -> type[SpherePredictor]:
    """The class of a predictor without depth estimation."""
    return SpherePredictor


@pytest.fixture(scope="session")
def write_pair() -> Callable[..., Path]:
    """Write a pair of noise panoramas, 0.5 m apart, with poses.json."""
    return _write_pair


@pytest.fixture
def pair_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A pair of 16 rows; the user's cache folder is `cache` in the same temporary folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return _write_pair(tmp_path / "pair")


@pytest.fixture(scope="session")
def small_config() -> Any:
    """The config of a narrow PanSplat without the monocular network."""
    from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel  # after the import hook
    from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
    from pansplat.model.heads import AdapterConfig, HeadsConfig
    from pansplat.model.pansplat import PanSplatConfig

    return PanSplatConfig(
        features=FeaturePyramidConfig(channels=(4, 8, 8, 16), transformer=TransformerConfig(channels=16, blocks=2)),
        cost_volume=CostVolumeConfig(
            mono_channels=0, levels=(SweepLevel(3, 16, 8, 32), SweepLevel(2, 8, 4, 32), SweepLevel(1, 8, 4, 32))
        ),
        heads=HeadsConfig(feature_channels=(16, 8, 8, 4), candidates=4, adapter=AdapterConfig(degree=1)),
    )


@pytest.fixture
def any_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last state of a refinement is kept: random images say nothing about pictures between the cameras."""
    monkeypatch.setattr("pansplat.refinement.refinement._MAX_ERROR_RATIO", 1e9)
