"""LPIPS equals the lpips package for all three classifiers, in bands too; its files are found or named."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import expect_error
from torch import Tensor

from pansplat.errors import InputError
from pansplat.evaluation import lpips
from pansplat.evaluation.lpips import FOLDER_VARIABLE, LAYER_CHANNELS, Backbone, Lpips, find_backbone, load_lpips

# lpips 0.1.4 (PyPI, torchvision 0.29.2, torch 2.13.0, float64) of `pair()` with `normalize=True`; its heads, and a
# classifier with the weights of `recipe`, loaded into `LPIPS(...).net` by name.
RECIPE_VALUES: dict[Backbone, float] = {"vgg": 0.0726357020, "alex": 0.0342026892, "squeeze": 0.0611231423}
# With the trained SqueezeNet 1.1 of ../shared/weights.
TRAINED_VALUE = 0.2198666598
TOLERANCE = 1e-7  # the package keeps the mean and deviation of its training in float32


def pair() -> tuple[Tensor, Tensor]:
    """Two reproducible images (1 3 66 100), float64 of float32 values."""
    noise = 0.1 * torch.sin(torch.arange(66 * 100 * 3).reshape(3, 66, 100).double() * 1.7).float()
    return waves(0.0)[None].double(), (waves(0.7) + noise)[None].double()


def waves(phase: float) -> Tensor:
    row, column = torch.meshgrid(torch.arange(66).double(), torch.arange(100).double(), indexing="ij")
    channels = [0.5 + 0.4 * torch.sin((c + 1) * (row / 7 + column / 11) + phase) for c in range(3)]
    return torch.stack(channels).float()


def recipe(name: str, shape: torch.Size) -> Tensor:
    """Normal weights of a layer, seeded by its torchvision name."""
    drawn = np.random.RandomState(zlib.crc32(name.encode())).standard_normal(shape)
    scale = np.sqrt(2 / np.prod(shape[1:])) if name.endswith("weight") else 0.1
    return torch.from_numpy(scale * drawn).float()


def write_classifier(path: Path, backbone: Backbone) -> None:
    layers = {n: t.shape for n, t in Lpips(backbone).state_dict().items() if n.startswith("features.")}
    torch.save({name: recipe(name, shape) for name, shape in layers.items()}, path)


def write_heads(path: Path, backbone: Backbone) -> None:
    rows = enumerate(LAYER_CHANNELS[backbone].values())
    torch.save({f"lin{i}.model.1.weight": recipe(f"{i}.weight", (1, c, 1, 1)).abs() for i, c in rows}, path)


@pytest.fixture(scope="module")
def squeeze(tmp_path_factory: pytest.TempPathFactory) -> Lpips:
    """Squeeze with random weights, float64."""
    folder = tmp_path_factory.mktemp("weights")
    write_classifier(folder / "squeezenet1_1-made.pth", "squeeze")
    write_heads(folder / "squeeze.pth", "squeeze")
    return load_lpips("squeeze", folder).double()


@pytest.fixture
def empty_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The empty torch.hub cache of a machine without weights."""
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return tmp_path / "torch" / "hub" / "checkpoints"


@pytest.mark.shared
@pytest.mark.parametrize("backbone", RECIPE_VALUES)
def test_equals_the_lpips_package(shared: Path, tmp_path: Path, backbone: Backbone) -> None:
    file = {"vgg": "vgg16.pth", "alex": "alexnet.pth", "squeeze": "squeezenet1_1.pth"}[backbone]
    write_classifier(tmp_path / file, backbone)
    (tmp_path / "lpips_heads").symlink_to(shared / "weights" / "lpips_heads")
    metric = load_lpips(backbone, tmp_path).double()
    assert float(metric(*pair())) == pytest.approx(RECIPE_VALUES[backbone], rel=TOLERANCE)


@pytest.mark.shared
def test_equals_the_lpips_package_with_trained_weights(shared: Path) -> None:
    metric = load_lpips("squeeze", shared / "weights").double()
    assert float(metric(*pair())) == pytest.approx(TRAINED_VALUE, rel=TOLERANCE)


def test_the_distance_is_symmetric_zero_for_equal_images_and_that_of_each_of_a_batch(squeeze: Lpips) -> None:
    a, b = pair()
    both, swapped = squeeze(torch.cat((a, b)), torch.cat((b, b))), float(squeeze(b, a))
    assert both.tolist() == pytest.approx([swapped, 0.0], abs=1e-12) and swapped > 0
    assert float(squeeze(a, b, torch.full((1, 66, 100), 0.3).double())) == pytest.approx(swapped, rel=1e-12)


def test_pixels_of_weight_zero_have_no_effect(squeeze: Lpips) -> None:
    a, b = pair()
    weights = torch.ones(1, 66, 100, dtype=torch.float64)
    weights[:, 40:] = 0
    changed = a.clone()
    changed[..., 40:, :] = 7.0
    assert float(squeeze(changed, b, weights)) == pytest.approx(float(squeeze(a, b, weights)), rel=1e-12)
    below = b.clone()
    below[..., :40, :] = a[..., :40, :]
    assert float(squeeze(a, below, weights)) == 0
    assert float(squeeze(a, b, torch.zeros_like(weights))) == 0


def test_small_images_are_refused(squeeze: Lpips) -> None:
    small = torch.zeros(1, 3, 16, 32, dtype=torch.float64)
    expect_error("32 pixels or more along each side, got 16x32", squeeze, small, small)


def test_missing_files_are_named_with_their_source_and_folders(empty_hub: Path, tmp_path: Path) -> None:
    write_heads(tmp_path / "vgg.pth", "vgg")
    with pytest.raises(InputError) as error:
        load_lpips("vgg", tmp_path)
    source = "vgg16-397923af.pth (from https://download.pytorch.org/models/vgg16-397923af.pth)"
    for part in (source, str(tmp_path), str(empty_hub), FOLDER_VARIABLE):
        assert part in str(error.value)
    assert "vgg.pth (from" not in str(error.value) and find_backbone(tmp_path) is None


@pytest.mark.parametrize("place", ["folder", "variable", "hub"])
def test_files_are_found_in_every_folder(place: str, empty_hub, tmp_path, monkeypatch) -> None:
    folder = empty_hub if place == "hub" else tmp_path / "mine"
    (folder / "lpips_heads").mkdir(parents=True)
    write_classifier(folder / "squeezenet1_1-b8a52dc0.pth", "squeeze")
    write_heads(folder / "lpips_heads" / "squeeze.pth", "squeeze")
    if place == "variable":
        monkeypatch.setenv(FOLDER_VARIABLE, str(folder))
    given = folder if place == "folder" else None
    assert find_backbone(given) == "squeeze"
    assert load_lpips("squeeze", given).name == "lpips-squeeze"


def test_a_file_of_another_classifier_is_refused(empty_hub: Path, tmp_path: Path) -> None:
    write_classifier(tmp_path / "vgg16.pth", "alex")
    write_heads(tmp_path / "vgg.pth", "vgg")
    expect_error(r"vgg16\.pth: .*features\.0\.weight of \(64, 3, 3, 3\)", load_lpips, "vgg", tmp_path)


@pytest.fixture(scope="module")
def vgg() -> Lpips:
    """VGG with random weights, float64."""
    torch.manual_seed(0)
    metric = Lpips("vgg").double()
    for head in metric.heads:
        head.uniform_()
    return metric


def measure_distances(metric: Lpips, size: tuple[int, int], weighted: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """The distances of two pairs of images, and their gradient."""
    generator = torch.Generator().manual_seed(1)
    shape = (2, 3, *size)
    a, b = (torch.rand(shape, generator=generator, dtype=torch.float64) for _ in range(2))
    weights = torch.rand(2, *size, generator=generator, dtype=torch.float64) if weighted else None
    a.requires_grad_()
    found = metric(a, b, weights)
    found.sum().backward()
    assert a.grad is not None
    return found.detach(), a.grad


@pytest.mark.slow
@pytest.mark.parametrize(("size", "pixels", "weighted"), [((64, 48), 1000, False), ((35, 32), 1, True)])
def test_bands_change_neither_distances_nor_gradients(size, pixels, weighted, vgg, monkeypatch) -> None:
    expected, expected_gradient = measure_distances(vgg, size, weighted)
    monkeypatch.setattr(lpips, "_MAX_WHOLE_PIXELS", 0)
    monkeypatch.setattr(lpips, "_BAND_PIXELS", pixels)
    found, gradient = measure_distances(vgg, size, weighted)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-9, atol=1e-9 * float(expected_gradient.abs().max()))
    assert float(expected.min()) > 0.01
