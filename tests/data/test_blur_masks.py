"""What a blur mask hides has no influence on anything that is read, and masks that cannot be used are refused."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pansplat import pipeline
from pansplat.batch import _hash_pair
from pansplat.data.blur_masks import blur_hidden, find_blur_mask, resize_hidden, widen_hidden
from pansplat.data.folders import load_pairs
from pansplat.data.images import read_blur_mask, read_panorama, read_thumbnail, write_image
from pansplat.data.reconstructions.dataset import PosedPanorama, write_dataset
from pansplat.errors import InputError, InputWarning
from pansplat.poses.files import _hash_inputs

HEIGHT = 64
HIDDEN = np.zeros((HEIGHT, 2 * HEIGHT), bool)
HIDDEN[20:44, :10] = HIDDEN[20:44, 118:] = True  # across the seam
HIDDEN[58:, 40:60] = True
WIDE = widen_hidden(HIDDEN)  # what is blurred


def _make_photograph(person: int = 0) -> np.ndarray:
    """A room that does not change and, where it is hidden, another person for each number."""
    pixels = np.random.default_rng(7).integers(60, 200, (HEIGHT, 2 * HEIGHT, 3), dtype=np.uint8)
    pixels[HIDDEN] = np.random.default_rng(person).integers(0, 255, (int(HIDDEN.sum()), 3), dtype=np.uint8)
    return pixels


def _write(path: Path, person: int, mask: np.ndarray | None = HIDDEN) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(_make_photograph(person)).save(path)
    if mask is not None:
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(path.with_name(f"{path.stem}_blur.png"))
    return path


def _write_pair(folder: Path, person: int) -> Path:
    poses = {}
    for number, name in enumerate(("left.png", "right.png")):
        _write(folder / name, person + number)
        pose = np.eye(4)
        pose[0, 3] = 0.5 * number
        poses[name] = {"cam2world": pose.tolist()}
    (folder / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    return folder


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
@pytest.mark.parametrize("height", [1, 2, 3, 50, HEIGHT])
def test_hidden_pixels_have_no_influence_and_others_do_not_change(kind: type, height: int) -> None:
    random = np.random.default_rng(0)
    hidden = random.random((height, 2 * height)) < 0.7
    hidden[0, 0], hidden[-1, -1] = True, False
    scale = 1 if kind is np.uint8 else 255
    first, second = ((random.integers(0, 255, (height, 2 * height, 3)) / scale).astype(kind) for _ in range(2))
    second[~hidden] = first[~hidden]
    blurred = blur_hidden(first, hidden)
    assert blurred.dtype == kind and np.array_equal(blurred, blur_hidden(second, hidden))
    assert np.array_equal(blurred[~hidden], first[~hidden])
    assert blurred.min() >= 0 and blurred.max() <= 255 / scale


def test_the_blur_is_the_colour_around_it_across_the_seam() -> None:
    color = np.full((64, 128, 3), (10, 120, 230), np.uint8)
    color[:, 40:90] = 0
    hidden = np.zeros((64, 128), bool)
    hidden[20:40, :20] = hidden[20:40, 110:] = True
    assert np.abs(blur_hidden(color, hidden)[hidden].astype(int) - (10, 120, 230)).max() <= 1
    rolled = blur_hidden(np.roll(color, 64, axis=1), np.roll(hidden, 64, axis=1))
    assert np.array_equal(np.roll(rolled, 64, axis=1), blur_hidden(color, hidden))


@pytest.mark.parametrize("height", [16, 64, 100])
def test_a_mask_of_another_size_hides_every_pixel_that_it_touches(height: int) -> None:
    resized = resize_hidden(HIDDEN, height)
    assert resized.shape == (height, 2 * height)
    rows, columns = np.nonzero(HIDDEN)
    for offset in (0.01, 0.5, 0.99):
        y, x = ((np.stack((rows, columns)) + offset) * height / HEIGHT).astype(int)
        assert resized[y, x].all()
    assert resized.mean() < 2 * HIDDEN.mean() + 0.05


def test_white_that_is_transparent_hides_nothing(tmp_path: Path) -> None:
    pixels = np.full((8, 16, 4), 255, np.uint8)
    pixels[2:, :, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "a_blur.png")
    hidden = read_blur_mask(tmp_path / "a_blur.png", 8)
    assert hidden[:2].all() and not hidden[2:].any()


def test_a_margin_is_hidden_across_the_seam() -> None:
    hidden = np.zeros((256, 512), bool)
    hidden[100, 511] = True
    rows, columns = np.nonzero(widen_hidden(hidden))
    assert {*rows.tolist()} == {98, 99, 100, 101, 102} and {*columns.tolist()} == {509, 510, 511, 0, 1}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr"])
def test_every_read_of_a_photograph_is_blurred(tmp_path: Path, suffix: str) -> None:
    reads = []
    for person in (1, 2):
        path = tmp_path / f"{person}" / f"a{suffix}"
        path.parent.mkdir()
        # JPEG mixes pixels within blocks of 16: these are hidden as a whole.
        mask = resize_hidden(HIDDEN, 4).repeat(16, axis=0).repeat(16, axis=1)
        if suffix == ".jpg":
            Image.fromarray(_make_photograph(person)).save(path, quality=90)
        else:
            write_image(path, _make_photograph(person))
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(path.with_name("a_blur.png"))
        image, opaque = read_panorama(path, HEIGHT)
        assert opaque.all()
        reads.append((image, read_panorama(path, 32)[0], read_thumbnail(path, 16)))
    for first, second in zip(*reads, strict=True):
        assert torch.equal(first, second)


def test_black_masks_change_nothing_and_a_mask_of_most_is_noted(tmp_path: Path) -> None:
    plain = read_panorama(_write(tmp_path / "plain.png", 1, None), HEIGHT)[0]
    assert torch.equal(read_panorama(_write(tmp_path / "a.png", 1, np.zeros_like(HIDDEN)), HEIGHT)[0], plain)
    with pytest.warns(InputWarning, match=r"b_blur\.png: 9\d% of the photograph is blurred; white is blurred"):
        read_panorama(_write(tmp_path / "b.png", 1, ~HIDDEN), HEIGHT)


def test_cube_faces_of_a_panorama_are_blurred(tmp_path: Path, color_face: Callable[[str, int], np.ndarray]) -> None:
    for face in "frblud":
        Image.fromarray(color_face(face, 32)).save(tmp_path / f"hall_{face}.png")
    (pair,) = load_pairs(tmp_path)
    plain = pair.load_context(HEIGHT)
    assert pair.context[0].name == "hall" and find_blur_mask(pair.context[0].image) is None
    Image.fromarray(np.where(HIDDEN, 255, 0).astype(np.uint8)).save(tmp_path / "hall_blur.png")
    (pair,) = load_pairs(tmp_path)
    assert find_blur_mask(pair.context[0].image) == tmp_path / "hall_blur.png"
    views = pair.load_context(HEIGHT)
    hidden = torch.from_numpy(WIDE)
    assert torch.equal(views.images[0][:, ~hidden], plain.images[0][:, ~hidden])
    assert (views.images - plain.images).abs()[0][:, hidden].max() > 0.1


def test_scenes_and_training_sets_of_different_hidden_people_are_equal(
    tmp_path: Path, sphere_predictor: Callable[[], object]
) -> None:
    scenes, sets = [], []
    for person in (1, 5):
        (pair,) = load_pairs(_write_pair(tmp_path / f"{person}", person))
        scenes.append(pipeline.predict(pair, sphere_predictor(), height=HEIGHT).gaussians)  # type: ignore[arg-type]
        folder = tmp_path / f"set{person}"
        folder.mkdir()
        posed = [PosedPanorama(view, view.cam2world, pair.siblings) for view in pair.context]
        write_dataset(folder, posed, np.zeros((1, 3)), np.zeros((1, 3), np.uint8), lambda what, done: None)
        sets.append({file.name: file.read_bytes() for file in sorted(folder.rglob("*.png"))})
    assert torch.equal(scenes[0].harmonics, scenes[1].harmonics) and torch.equal(scenes[0].means, scenes[1].means)
    assert len(sets[0]) == 12 and sets[0] == sets[1], "the faces"


def test_caches_depend_on_the_mask(tmp_path: Path, sphere_predictor: Callable[[], object]) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    (pair,) = load_pairs(folder)
    predictor = sphere_predictor()

    def list_keys() -> list[object]:
        pipeline.predict(pair, predictor, height=HEIGHT)  # type: ignore[arg-type]
        return [_hash_pair(pair), _hash_inputs(pair.context, 1.5), predictor.calls]  # type: ignore[attr-defined]

    first = list_keys()
    assert list_keys() == first
    _write(folder / "left.png", 1, np.roll(HIDDEN, 4, axis=0))
    second = list_keys()
    assert all(a != b for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        (
            "lefd_blur.png",
            (128, 64),
            r"lefd_blur\.png: needed the name of a panorama .* got 'lefd' \(did you mean left_",
        ),
        ("left_blur.png", (64, 64), r"left_blur\.png: needed a blur mask of the proportions .* 2:1, got 64x64"),
        ("left_blur.jpg", (128, 64), r"left_blur\.jpg: needed a blur mask as PNG, got \.jpg"),
    ],
)
def test_a_mask_that_hides_nothing_by_mistake_is_refused(
    tmp_path: Path, name: str, size: tuple[int, int], message: str
) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    for mask in folder.glob("*_blur.png"):
        mask.unlink()
    Image.new("L", size).save(folder / name)
    with warnings.catch_warnings(), pytest.raises(InputError, match=message):
        warnings.filterwarnings("ignore", message=r".*has no pose of left_blur\.jpg")
        load_pairs(folder)
    (folder / "poses.json").unlink()
    with pytest.raises(InputError, match=message):
        load_pairs(folder)
    if "lefd" not in name:
        with pytest.raises(InputError, match=message):
            load_pairs(folder / "left.png")


def test_damaged_and_white_masks_are_refused(tmp_path: Path) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    mask = folder / "left_blur.png"
    Image.new("L", (128, 64), 255).save(mask)
    with pytest.raises(InputError, match=r"left_blur\.png: needed a blur mask with black .* got white only"):
        load_pairs(folder)[0].load_context(HEIGHT)
    mask.write_bytes(mask.read_bytes()[:60])
    with pytest.raises(InputError, match=r"left_blur\.png: needed .* got damaged or truncated data"):
        load_pairs(folder)
    with pytest.raises(InputError, match=r"left_blur\.png: needed .* got damaged or truncated data"):
        read_panorama(folder / "left.png", HEIGHT)


def test_a_mask_is_no_panorama(tmp_path: Path) -> None:
    _write(tmp_path / "a.png", 1)
    (pair,) = load_pairs(tmp_path)
    assert [view.name for view in pair.context] == ["a"]
