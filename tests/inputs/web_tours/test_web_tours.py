"""Whatever a tour's file holds, it opens in part or is refused with a message."""

import copy
import json
import random
import warnings
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pansplat.errors import InputError
from pansplat.inputs.folders import load_panoramas

_VALUES = (
    10**400,
    1e300,
    -1,
    0,
    "../x",
    "http://x",
    "hall",
    "hall.jpg",
    "cubemap",
    "multires",
    "%s",
    "{row}",
    "",
    "\ud800",
)
_SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | st.sampled_from(_VALUES)
_JSON = st.recursive(
    _SCALARS,
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)
_MULTIRES = {"path": "/%l/%s%y_%x", "tileResolution": 4, "maxLevel": 1, "cubeResolution": 4, "fallbackPath": "/f/%s"}
_TOURS = {
    "tour.json": {
        "default": {"firstScene": "hall", "basePath": "."},
        "scenes": {
            "hall": {"title": "Hall", "panorama": "hall.jpg", "hotSpots": [{"sceneId": "b", "yaw": 1, "pitch": 2}]},
            "b": {"type": "cubemap", "cubeMap": ["hall.jpg"] * 6},
            "c": {"type": "multires", "multiRes": _MULTIRES, "yaw": 3, "haov": 360},
        },
    },
    "data.js": {
        "scenes": [
            {
                "id": "0-hall",
                "name": "Hall",
                "levels": [{"size": 4, "tileSize": 4, "fallbackOnly": True}, {"size": 4, "tileSize": 4}],
                "initialViewParameters": {"yaw": 0, "pitch": 0},
                "linkHotspots": [{"yaw": 0, "pitch": 1, "target": "1-b"}],
                "infoHotspots": [{"title": "x"}],
            }
        ]
    },
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, write_scene, write_tiles) -> Path:
    folder = tmp_path_factory.mktemp("tour")
    write_scene(folder / "hall.jpg", 8)
    write_tiles(4, 4, lambda face, row, column: folder / f"tiles/0-hall/1/{face}/{row}/{column}.jpg")
    write_tiles(4, 4, lambda face, row, column: folder / f"1/{face}{row}_{column}.jpg")
    return folder


def _graft(content: Any, value: Any, rng: random.Random) -> Any:
    """A copy with one of its parts replaced."""
    root = {"": copy.deepcopy(content)}
    holder, key, part = root, "", root[""]
    while isinstance(part, (dict, list)) and part and rng.random() < 0.8:
        holder, key = part, rng.choice(list(part)) if isinstance(part, dict) else rng.randrange(len(part))
        part = holder[key]
    holder[key] = value
    return root[""]


@pytest.mark.parametrize("name", _TOURS)
@settings(max_examples=150, suppress_health_check=list(HealthCheck))
@given(value=_JSON, seed=st.integers(0, 10**6))
def test_any_value_is_read_or_refused_with_a_message(folder: Path, name: str, value: Any, seed: int) -> None:
    text = json.dumps(_graft(_TOURS[name], value, random.Random(seed)))
    for other in _TOURS:
        (folder / other).unlink(missing_ok=True)
    (folder / name).write_text(text if name == "tour.json" else f"var APP_DATA = {text};")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            panoramas = load_panoramas(folder / name)
        except InputError as error:
            assert str(folder / name) in str(error)
        else:
            names = {panorama.name for panorama in panoramas}
            assert panoramas and len(names) == len(panoramas)
            assert all(panorama.image.is_file() for panorama in panoramas)
            assert all(link.target in names for panorama in panoramas for link in panorama.links)


@pytest.mark.parametrize("name", _TOURS)
@settings(max_examples=150, suppress_health_check=list(HealthCheck))
@given(cut=st.integers(0, 900), junk=st.text(max_size=6))
def test_damaged_text_is_read_or_refused_with_a_message(folder: Path, name: str, cut: int, junk: str) -> None:
    text = f"var APP_DATA = {json.dumps(_TOURS[name])};"[0 if name == "data.js" else 15 :]
    for other in _TOURS:
        (folder / other).unlink(missing_ok=True)
    (folder / name).write_text(text[:cut] + junk + text[cut + len(junk) :], errors="surrogatepass")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            assert load_panoramas(folder / name)
        except InputError as error:
            assert str(folder / name) in str(error)
