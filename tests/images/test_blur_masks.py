"""What a blur mask hides has no influence on anything that is read, and masks that cannot be used are refused."""

import json
import unicodedata
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from panorama_formats import EXAMPLES, write_posed, write_room
from PIL import Image
from refusals import expect_error

from pansplat import pipeline
from pansplat.cli.pose import Pose
from pansplat.errors import InputError, InputWarning
from pansplat.export.training_set import write_dataset
from pansplat.images.blur_masks import blur_hidden, find_blur_mask, resize_hidden, widen_hidden
from pansplat.images.image_files import read_blur_mask, read_panorama, read_thumbnail, write_image
from pansplat.inputs.content import hash_context, hash_panorama
from pansplat.inputs.folders import load_panoramas, load_sets
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.poses.files import _hash_inputs
from pansplat.system.store import hash_parts
from pansplat.training.sequences import LOCATIONS, read_loc360

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
        _draw_mask(path.with_name(f"{path.stem}_blur.png"), mask)
    return path


def _write_pair(folder: Path, person: int) -> Path:
    pictures = {f"{name}.png": _make_photograph(person + n) for n, name in enumerate(("left", "right"))}
    write_posed(folder, pictures, (0, 0.5))
    for name in ("left", "right"):
        _draw_mask(folder / f"{name}_blur.png")
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
    assert np.abs(np.roll(rolled, 64, axis=1) - blur_hidden(color, hidden).astype(int)).max() <= 1, "but for rounding"


@pytest.mark.parametrize("height", [16, 64, 100])
def test_a_mask_of_another_size_hides_every_pixel_that_it_touches(height: int) -> None:
    resized = resize_hidden(HIDDEN, height, 2 * height)
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
        mask = resize_hidden(HIDDEN, 4, 8).repeat(16, axis=0).repeat(16, axis=1)
        if suffix == ".jpg":
            Image.fromarray(_make_photograph(person)).save(path, quality=90)
        else:
            write_image(path, _make_photograph(person))
        _draw_mask(path.with_name("a_blur.png"), mask)
        image, opaque = read_panorama(path, HEIGHT)
        assert opaque.all()
        reads.append((image, read_panorama(path, 32)[0], read_thumbnail(path, 16)))
    for first, second in zip(*reads, strict=True):
        assert torch.equal(first, second)


def test_black_masks_change_nothing_and_a_mask_of_most_is_noted(tmp_path: Path) -> None:
    plain = read_panorama(_write(tmp_path / "plain.png", 1, None), HEIGHT)[0]
    assert torch.equal(read_panorama(_write(tmp_path / "a.png", 1, np.zeros_like(HIDDEN)), HEIGHT)[0], plain)
    with pytest.warns(InputWarning, match=r"b_blur\.png: 9\d%"):
        read_panorama(_write(tmp_path / "b.png", 1, ~HIDDEN), HEIGHT)


def test_cube_faces_of_a_panorama_are_blurred(tmp_path: Path, color_face: Callable[[str, int], np.ndarray]) -> None:
    for face in "frblud":
        Image.fromarray(color_face(face, 32)).save(tmp_path / f"hall_{face}.png")
    (pair,) = load_sets(tmp_path)
    plain = pair.load_context(HEIGHT)
    assert pair.context[0].name == "hall" and find_blur_mask(pair.context[0].image) is None
    _draw_mask(tmp_path / "hall_blur.png")
    views = load_sets(tmp_path)[0].load_context(HEIGHT)
    hidden = torch.from_numpy(WIDE)
    assert torch.equal(views.images[0][:, ~hidden], plain.images[0][:, ~hidden])
    assert (views.images - plain.images).abs()[0][:, hidden].max() > 0.1


def test_damaged_masks_and_those_that_hide_all_are_refused(tmp_path: Path) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    hidden = _draw_mask(folder / "left_mask.png", np.ones_like(HIDDEN), kind="mask")
    expect_error(r"left_mask\.png: needed some pixels", lambda: load_sets(folder)[0].load_context(HEIGHT))
    hidden.unlink()
    mask = folder / "left_blur.png"
    Image.new("L", (128, 64), 255).save(mask)
    expect_error(r"left_blur\.png: .*white only", lambda: load_sets(folder)[0].load_context(HEIGHT))
    Image.new("L", (64, 64)).save(mask)
    for path in (folder, folder / "left.png"):
        expect_error(r"left_blur\.png: .*128x64, got 64x64", load_sets, path)
    _draw_mask(mask)
    mask.write_bytes(mask.read_bytes()[:60])
    for read in (lambda: load_sets(folder), lambda: read_panorama(folder / "left.png", HEIGHT)):
        expect_error(r"left_blur\.png: .*damaged", read)


def _draw_mask(path: Path, hidden: np.ndarray = HIDDEN, kind: str = "blur") -> Path:
    """A mask file: white hides in blur masks, black in the others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    white = hidden if kind == "blur" else ~hidden
    Image.fromarray(np.where(white, 255, 0).astype(np.uint8)).save(path, path.suffix[1:].lower().replace("jpg", "jpeg"))
    return path


MASKS = "left_Blur.png", "LEFT_BLUR.PNG", "left_blur.png.png", "Left_Mask.PNG", "mask.PNG", "Mask.png"


@pytest.mark.parametrize("name", MASKS)
@pytest.mark.parametrize("is_posed", [True, False])
def test_a_mask_is_a_mask_in_any_case(tmp_path: Path, name: str, is_posed: bool) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    for mask in folder.glob("*_blur.png"):
        mask.unlink()
    if not is_posed:
        (folder / "poses.json").unlink()
    mask = _draw_mask(folder / name, kind="blur" if "blur" in name.lower() else "mask")
    panoramas = load_sets(folder)[0].context if is_posed else load_panoramas(folder)
    assert [view.name for view in panoramas] == ["left", "right"]
    for view in (panoramas[0], load_sets(folder / "left.png")[0].context[0]):
        assert mask in (view.mask, find_blur_mask(view.image))


@pytest.mark.parametrize(
    ("name", "right"),
    [
        ("lefd_Blur.PNG", "left_blur.*"),
        ("left_blur.jpg", "left_blur.png"),
        ("lefd_mask.png", "left_mask.png"),
        ("left_Mask.JPG", "left_mask.png"),
        ("mask.jpg", ""),
        ("masks/left_blur.png", "left_blur.png"),
    ],
)
@pytest.mark.parametrize("is_posed", [True, False])
def test_a_mask_that_is_not_applied_is_refused(tmp_path: Path, name: str, right: str, is_posed: bool) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    if not is_posed:
        (folder / "poses.json").unlink()
    _draw_mask(folder / name, kind="blur" if "blur" in name.lower() else "mask")
    for path in (folder, *([folder / "left.png"] if name == "left_blur.jpg" else [])):
        with warnings.catch_warnings(), pytest.raises(InputError, match=rf"{name}: needed the name.*{right}"):
            warnings.filterwarnings("ignore", message=r".*has no pose of left_blur\.jpg")
            load_sets(path)


def test_two_masks_of_a_panorama_are_refused(tmp_path: Path) -> None:
    _draw_mask(_write_pair(tmp_path / "pair", 1) / "left_Blur.png")
    expect_error(r"left\.png: .*left_Blur\.png, left_blur\.png", load_sets, tmp_path / "pair")


def test_masks_that_poses_state_have_any_name(tmp_path: Path) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    content = json.loads((folder / "poses.json").read_text())
    for number, name in enumerate(("masks/of_all_mask.png", "tripod_mask.jpg")):
        _draw_mask(folder / name, kind="mask")
        content["poses"][("left.png", "right.png")[number]]["mask"] = name
    (folder / "poses.json").write_text(json.dumps(content))
    assert not load_sets(folder)[0].load_context(HEIGHT).masks.all()


def test_a_scene_file_is_no_mask(tmp_path: Path) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    for name in ("blur.ply", "mask.compressed.ply", "left_blur.spz"):
        (folder / name).write_bytes(b"")
    assert len(load_sets(folder)) == 1


@pytest.mark.parametrize("source", ["file", "poses.json", "pose folder"])
def test_a_mask_is_never_a_panorama(tmp_path: Path, source: str) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    mask = _draw_mask(folder / "lefd_Blur.jpg") if source == "pose folder" else folder / "left_blur.png"
    if source == "poses.json":  # written by older versions
        content = json.loads((folder / "poses.json").read_text())
        content["poses"][mask.name] = content["poses"]["left.png"]
        (folder / "poses.json").write_text(json.dumps(content))
    read = Pose(folder).run if source == "pose folder" else lambda: load_sets(mask if source == "file" else folder)
    expect_error(f"{mask.name}: needed", read)


def test_a_mask_of_no_frame_of_360loc_is_refused(tmp_path: Path) -> None:
    folders = [tmp_path / location / "mapping" / "daytime_360_0" for location in LOCATIONS["val"]]
    for folder in folders:
        _write(folder / "image" / "frame_0.png", 0, None)
        (folder / "camera_pose.json").write_text(json.dumps({"frame_0.png": np.eye(4).tolist()}))
    assert read_loc360(tmp_path, "val")
    _draw_mask(folders[-1] / "image" / "frame_1_blur.png")
    expect_error(r"frame_1_blur\.png: .*frame_0_blur", read_loc360, tmp_path, "val")


def _write_example(folder: Path, name: str) -> Path:
    """Two panoramas, hall and room, of cube faces or of perspective pictures of 8 x 8 pixels."""
    EXAMPLES[name].state(write_room(folder, NAMES), NAMES)
    (folder / "scale.txt").write_text("1\n")
    return folder


NAMES = "hall.png", "room.png"
COVER = np.ones((8, 8), bool)  # what a mask of a picture covers


@pytest.mark.parametrize("kind", ["cube faces", "rigs"])
def test_the_masks_of_a_panorama_of_pictures_are_found(tmp_path: Path, kind: str) -> None:
    folder = _write_example(tmp_path / "set", kind)
    _draw_mask(folder / "hall_Blur.PNG")
    _draw_mask(folder / "hall_mask.png", kind="mask")
    panorama = load_panoramas(folder)[0]
    assert find_blur_mask(panorama.image) == folder / "hall_Blur.PNG" and panorama.mask == folder / "hall_mask.png"


@pytest.mark.filterwarnings("ignore:.*in no picture")
@pytest.mark.parametrize(
    "name", ["faces/Hall_0_mask.png", "masks/faces/hall_0.png.png", "masks/Hall_0.PNG.png", "masks/hall_0.png"]
)
def test_a_scene_mask_of_a_perspective_picture_masks_it(tmp_path: Path, name: str) -> None:
    folder = _write_example(tmp_path / "set", "rigs")
    _draw_mask(folder / name, COVER, kind="mask")
    masks = load_sets(folder)[0].load_context(64).masks
    assert not masks[0, 32, 64] and masks[0, :, :32].all() and masks[1].all(), "the first picture is ahead"


@pytest.mark.parametrize(
    ("kind", "name", "got"),
    [
        ("cube faces", "hall_blur.png", "32x16, got 8x8"),
        ("cube faces", "hall_f_blur.png", "[/ ]hall_blur"),
        ("cube faces", "hall_f_mask.png", r"hall_mask\.png"),
        ("rigs", "faces/Hall_0_BLUR.png", "[/ ]hall_blur"),
        ("rigs", "faces/hall_blur.png", "set/hall_blur"),
        ("rigs", "masks/hall_9.png.png", "the name of a picture"),
        ("rigs", "masks/hall_0_blur.png", "the name"),
    ],
)
def test_a_mask_that_no_panorama_of_pictures_applies_is_refused(tmp_path: Path, kind: str, name: str, got: str) -> None:
    mask = _draw_mask(_write_example(tmp_path / "set", kind) / name, COVER)
    expect_error(f"{mask.name}: needed.*{got}", load_panoramas, tmp_path / "set")


def test_masks_beside_a_link_are_applied_and_those_beside_its_file_are_refused(tmp_path: Path) -> None:
    folder = _write_pair(tmp_path / "pair", 1)
    (tmp_path / "store").mkdir()
    moved = (folder / "left.png").rename(tmp_path / "store" / "left.png")
    (folder / "left.png").symlink_to(moved)
    assert find_blur_mask(load_panoramas(folder)[0].image) == folder / "left_blur.png"
    (folder / "left_blur.png").rename(tmp_path / "store" / "left_blur.png")
    expect_error(r"store/left_blur\.png: needed", load_sets, folder)


@pytest.mark.parametrize("forms", [("NFC", "NFD"), ("NFD", "NFC")])
def test_a_name_has_its_mask_in_both_forms_of_unicode(tmp_path: Path, forms: tuple[str, str]) -> None:
    """Copies from macOS have accents as characters of their own."""
    picture, name = (unicodedata.normalize(form, "K\u00fcche") for form in forms)  # type: ignore[arg-type]
    _write(tmp_path / f"{picture}.png", 1, None)
    mask = _draw_mask(tmp_path / f"{name}_blur.png")
    found = find_blur_mask(load_panoramas(tmp_path)[0].image)
    assert found is not None and found.samefile(mask)


def test_scenes_training_sets_and_caches_depend_on_what_masks_leave(tmp_path, sphere_predictor) -> None:
    def list_keys(pair: PanoramaSet) -> tuple[str, ...]:
        """Those of predictions, of estimated poses, and of pages."""
        return hash_context(pair), _hash_inputs(pair.context, 1.5), hash_parts(*map(hash_panorama, pair.context))

    scenes, sets, predictor, nothing = [], [], sphere_predictor(), np.zeros((1, 3))
    for person in (1, 5):
        folder, new = tmp_path / f"{person}", tmp_path / f"new{person}"
        mask = _write_pair(folder, person) / "left_blur.png"
        before, keys = mask.rename(tmp_path / "mask.png"), []
        for _ in range(2):
            (pair,) = load_sets(folder)
            scenes.append(pipeline.predict(pair, predictor, height=HEIGHT).gaussians)  # type: ignore[arg-type]
            keys.append(list_keys(pair))
            if not mask.exists():
                before.rename(mask)
        new.mkdir()
        write_dataset(new, pair.context, pair.siblings, nothing, nothing.astype(np.uint8))
        sets.append({file.name: file.read_bytes() for file in new.rglob("*.*")})
        _draw_mask(mask, np.roll(HIDDEN, 4, axis=0))
        keys.append(list_keys(pair))
        assert all(len(set(values)) == 3 for values in zip(*keys, strict=True)), "without, with, and with another mask"
    plain, first, _, second = scenes
    assert torch.equal(first.harmonics, second.harmonics) and torch.equal(first.means, second.means)
    assert not torch.equal(plain.harmonics, first.harmonics)
    assert sets[0] == sets[1] and len(sets[0]) > 12, "the faces"


def test_a_web_tour_names_the_picture_of_its_masks(tmp_path: Path) -> None:
    """The name of a panorama of a tour is that of its scene, its mask has the name of its picture."""
    _write(tmp_path / "panos" / "IMG_1.png", 1, None)
    tour = {"scenes": {"kitchen": {"type": "equirectangular", "panorama": "panos/IMG_1.png"}}}
    (tmp_path / "tour.json").write_text(json.dumps(tour))
    _draw_mask(tmp_path / "kitchen_blur.png")
    expect_error(r"kitchen_blur\.png: .*IMG_1_blur\.png", load_sets, tmp_path)
    (tmp_path / "kitchen_blur.png").rename(tmp_path / "panos" / "IMG_1_Blur.PNG")
    assert find_blur_mask(load_panoramas(tmp_path)[0].image) == tmp_path / "panos" / "IMG_1_Blur.PNG"
