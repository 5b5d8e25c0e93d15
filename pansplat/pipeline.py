"""The calls a user needs: load pairs and predictors, predict, render, save, load.

Every public name here is also an attribute of `pansplat` itself.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.atomic import replacing
from pansplat.data.pairs import Pair, load_pairs
from pansplat.data.views import Views
from pansplat.errors import InputError
from pansplat.gaussians.gaussians import Gaussians, no_gaussians
from pansplat.gaussians.ply import load_ply, save_ply
from pansplat.gaussians.ply_stream import save_ply_parts
from pansplat.gaussians.prune import prune
from pansplat.gaussians.scene import Scene
from pansplat.geometry.blending import blend_weights
from pansplat.model.checkpoint import SUFFIXES, CompatChoice
from pansplat.model.layers import Precision
from pansplat.predictor import Predictor, Progress
from pansplat.rendering import Rendering, rasterize
from pansplat.rendering import blend as blend_renderings
from pansplat.rendering.original import rasterize_as_original

__all__ = ["load", "load_model", "load_pairs", "predict", "predict_to_file", "render", "save"]

Drawing = Literal["exact", "original"]

_CACHE_FORMAT = "1"  # changes when the file's layout does, so that older files are not taken for newer ones
_FIELDS = ("means", "scales", "quats", "opacities", "harmonics", "levels", "views")


def load_model(
    name: str | Path = "sweep",
    *,
    compat: CompatChoice = "trained",
    precision: Precision = "float32",
    **options: Any,
) -> Predictor:
    """A predictor, ready to be called with tensors.

    Args:
        name: `sweep`, or a file of weights: a .safetensors that `pansplat convert` or training wrote, or an
            original checkpoint (.ckpt).
        compat: for networks: "official" computes what the original code does, its defects included; "fixed"
            corrects them; "trained" is the one that the weights were trained with. Original weights were trained
            with the defects, so for them it is "official".
        precision: for networks: number type of the convolutions; docs/bench_model.md has what bfloat16 gains and costs.
        **options: for the constructor of `sweep`; for networks, see `pansplat.model.loading.load_predictor`.

    Raises:
        InputError: when there is no such predictor, the processor lacks the precision, or the file cannot be used.
    """
    if compat not in get_args(CompatChoice):
        raise InputError(f"`compat` must be one of {', '.join(get_args(CompatChoice))}, got {compat!r}")
    if str(name) in _MODELS:
        if compat != "trained":
            raise InputError(f"`compat` is for networks, and {name} is none; leave it out")
        if precision != "float32":
            raise InputError(f"`precision` is for networks, and {name} is none; leave it out")
        return _MODELS[str(name)](**options)
    if Path(name).suffix.lower() not in SUFFIXES:
        raise InputError(
            f"`model` must be one of {', '.join(sorted(_MODELS))}, or a file of weights ({', '.join(SUFFIXES)}), got "
            f"{str(name)!r}"
        )
    from pansplat.model.loading import load_predictor

    return load_predictor(Path(name).expanduser(), compat, precision=precision, **options)


def _sweep(**options: Any) -> Predictor:
    from pansplat.sweep import Sweep

    return Sweep(**options)


_MODELS: dict[str, Callable[..., Predictor]] = {"sweep": _sweep}


def predict(
    source: Pair | Views | str | Path,
    model: str | Path | Predictor = "sweep",
    *,
    compat: CompatChoice = "trained",
    precision: Precision = "float32",
    height: int = 512,
    cache: bool = True,
    progress: Progress | None = None,
) -> Scene:
    """The scene seen by the context panoramas of a pair.

    A pair's result is kept beside it (`.pansplat/` in its folder, or the user's cache folder where that
    cannot be written) under a hash of everything it depends on: pixels, masks, poses, depth range, predictor.

    Args:
        source: a pair, the path of a folder that holds exactly one, or loaded panoramas (never cached).
        model: the name of a predictor, a file of weights, or a predictor.
        compat, precision: see `load_model`; a predictor keeps its own.
        height: panoramas are resized to (height, 2 height); loaded ones keep their size.
        cache: whether an earlier result may be returned and this one kept.
        progress: told what is being done and the fraction of the whole that is done.

    Raises:
        InputError: when the input cannot be used, or the path holds several pairs.
    """
    predictor = load_model(model, compat=compat, precision=precision) if isinstance(model, (str, Path)) else model
    pair = _only_pair(source) if isinstance(source, (str, Path)) else source
    if isinstance(pair, Views):
        return _predict(pair, predictor, progress)
    views = pair.load_context(height)
    if not cache:
        return _predict(views, predictor, progress)
    key = _cache_key(views, predictor)
    stem = f"{_slug(pair.name)}-{_slug(predictor.name)}-{height}"
    for folder in _cache_folders(pair):
        scene = _read_cached(folder / f"{stem}-{key}.scene", views, predictor)
        if scene is not None:
            if progress is not None:
                progress("kept from last time", 1.0)
            return scene
    scene = _predict(views, predictor, progress)
    _write_cached(scene.gaussians, _cache_folders(pair), stem, key)
    return scene


def predict_to_file(
    source: Pair | Views | str | Path,
    path: str | Path,
    model: str | Path | Predictor,
    *,
    compat: CompatChoice = "trained",
    precision: Precision = "float32",
    height: int = 512,
    degree: int | None = None,
    min_opacity: float = 0.0,
    progress: Progress | None = None,
) -> int:
    """Predict into a .ply file, tile by tile: for panoramas whose Gaussians do not fit in memory. Nothing is cached.

    The file holds what `predict` gives, in the order of tiles.

    Args:
        source, compat, precision, height, progress: as in `predict`.
        model: a network: a file of weights, or its predictor.
        degree: highest degree of harmonics to keep; None keeps all.
        min_opacity: Gaussians of less are left out.

    Returns:
        How many Gaussians the file holds.

    Raises:
        InputError: as `predict`; when the predictor is no network, or the file cannot be written.
    """
    _require_ply(path)
    predictor = load_model(model, compat=compat, precision=precision) if isinstance(model, (str, Path)) else model
    if not streams(predictor):
        raise InputError(f"{predictor.name} makes all Gaussians at once; use `predict` and `save`, or a network")
    pair = _only_pair(source) if isinstance(source, (str, Path)) else source
    views = pair if isinstance(pair, Views) else pair.load_context(height)
    parts: Iterator[Gaussians] = predictor.stream(  # pyright: ignore[reportAttributeAccessIssue]
        views.images, views.cam2world, views.near, views.far, masks=views.masks, progress=progress
    )
    pruned = (prune(part, degree=degree, min_opacity=min_opacity) for part in parts)
    return save_ply_parts(_scene(no_gaussians(), views, predictor), pruned, path)


def streams(predictor: Predictor) -> bool:
    """Whether `predict_to_file` can use the predictor."""
    return hasattr(predictor, "stream")


def render(
    scene: Scene,
    cam2world: Float[Tensor, "4 4"] | np.ndarray,
    *,
    blend: str | int = "deferred",
    size: tuple[int, int] | None = None,
    layout: str = "equirect",
    drawing: Drawing = "exact",
    **raster: Any,
) -> Rendering:
    """The scene seen from a pose: colour, alpha and radial depth.

    Args:
        scene: what to draw.
        cam2world: pose of the camera, OpenCV axes, metres.
        blend: "deferred" draws each context view's Gaussians by themselves and blends the pictures by
            nearness; "joint" draws all together; a number draws one view's only.
        size: (height, width) in pixels; by default the scene's own height, 2:1 (16:9 for `pinhole`).
        layout: "equirect", "cubemap" or "pinhole".
        drawing: "exact", or "original": a panorama as the original program draws it, its defects included, for the
            figures that were published of its weights (docs/paper.md).
        **raster: further options of `pansplat.rendering.rasterize`, with "exact".

    Raises:
        InputError: when `blend` names no view of the scene, or `drawing` does not go with the other options.
    """
    pose = torch.as_tensor(cam2world, dtype=torch.float64)
    if size is None:
        size = (scene.height, round(scene.height * 16 / 9) if layout == "pinhole" else 2 * scene.height)
    draw = _drawing(drawing, scene, size, layout, raster)
    count = len(scene.cam2world)
    if isinstance(blend, int):
        if not 0 <= blend < max(count, 1):
            raise InputError(f"`blend` must be a view from 0 to {max(count, 1) - 1}, got {blend}")
        return draw(scene.gaussians.select(scene.gaussians.views == blend), pose)
    if blend not in ("deferred", "joint"):
        raise InputError(f"`blend` must be deferred, joint or the number of a view, got {blend!r}")
    if blend == "joint" or count < 2:
        return draw(scene.gaussians, pose)
    weights = blend_weights(pose[:3, 3], scene.cam2world[:, :3, 3].double())
    # A view without weight leaves no trace in the blend: at an input, one drawing does.
    drawn = [view for view in range(count) if float(weights[view]) > 0]
    pictures = [draw(scene.gaussians.select(scene.gaussians.views == v), pose) for v in drawn]
    return pictures[0] if len(drawn) == 1 else blend_renderings(pictures, weights[drawn])


def _drawing(
    drawing: Drawing, scene: Scene, size: tuple[int, int], layout: str, raster: dict[str, Any]
) -> Callable[[Gaussians, Tensor], Rendering]:
    """How Gaussians become a picture of that size."""
    if drawing == "exact":
        return partial(rasterize, size=size, layout=layout, **raster)
    if drawing != "original":
        raise InputError(f"`drawing` must be exact or original, got {drawing!r}")
    if layout != "equirect" or set(raster) - {"backend"}:
        given = ", ".join([*sorted(raster), *(["layout"] if layout != "equirect" else [])])
        raise InputError(f"drawing='original' chooses all but size and backend itself, got {given}; leave them out")
    return partial(rasterize_as_original, size=size, near=scene.near, **raster)


def save(scene: Scene, path: str | Path) -> None:
    """Write a scene to a file; the suffix chooses the format (.ply: any 3DGS tool opens it)."""
    _require_ply(path)
    save_ply(scene, path)


def load(path: str | Path) -> Scene:
    """Read a scene from a file that `save`, or another 3DGS tool, has written."""
    _require_ply(path)
    return load_ply(path)


def _require_ply(path: str | Path) -> None:
    if Path(path).suffix.lower() != ".ply":
        raise InputError(f"{path}: a scene file must end in .ply, got {Path(path).suffix or 'no suffix'!r}")


def _only_pair(path: str | Path) -> Pair:
    pairs = load_pairs(path)
    if len(pairs) != 1:
        names = ", ".join(pair.name for pair in pairs[:8]) + (", ..." if len(pairs) > 8 else "")
        raise InputError(f"{path} holds {len(pairs)} pairs ({names}); choose one: predict(load_pairs(path)[0])")
    return pairs[0]


def _predict(views: Views, predictor: Predictor, progress: Progress | None) -> Scene:
    gaussians = predictor(views.images, views.cam2world, views.near, views.far, masks=views.masks, progress=progress)
    assert isinstance(gaussians, Gaussians)  # a list answers a batch only
    return _scene(gaussians, views, predictor)


def _scene(gaussians: Gaussians, views: Views, predictor: Predictor) -> Scene:
    return Scene(
        gaussians,
        views.cam2world.double(),
        near=views.near,
        far=views.far,
        names=views.names,
        model=predictor.name,
        height=views.images.shape[-2],
    )


# The prediction cache


def _cache_key(views: Views, predictor: Predictor) -> str:
    """Hash of all that a prediction depends on, as the predictor gets it.

    The decoded pixels are hashed, not the files: a mask that is found in the folder's other panoramas, or a
    decoder that changes, then changes the key as well.
    """
    digest = hashlib.blake2b(digest_size=16)
    shapes = [list(views.images.shape), views.near, views.far, predictor.name, predictor.fingerprint]
    digest.update(json.dumps([_CACHE_FORMAT, *shapes]).encode())
    for tensor in (views.images, views.cam2world.double(), views.masks):
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy()).data)
    return digest.hexdigest()


def _cache_folders(pair: Pair) -> list[Path]:
    """Where results may lie, best first: beside the pair, then with the user's other caches."""
    place = hashlib.blake2b(str(pair.folder.resolve()).encode(), digest_size=8).hexdigest()
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return [pair.folder / ".pansplat", Path(home) / "pansplat" / place]


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.]+", "_", name)[:60]


def _read_cached(path: Path, views: Views, predictor: Predictor) -> Scene | None:
    """The scene kept in a file; None when there is none or it is damaged in any way."""
    try:
        content = path.read_bytes()
        body, checksum = content[:-4], int.from_bytes(content[-4:], "little")
        if zlib.crc32(body) != checksum:
            return None
        tensors = safetensors.torch.load(body)
        gaussians = Gaussians(*(tensors[name] for name in _FIELDS))
    except (OSError, ValueError, KeyError, safetensors.SafetensorError):
        return None
    return _scene(gaussians, views, predictor)


def _write_cached(gaussians: Gaussians, folders: list[Path], stem: str, key: str) -> None:
    """Keep a result in the first folder that can be written; without any, do without."""
    tensors = {name: getattr(gaussians, name).detach().cpu().contiguous() for name in _FIELDS}
    body = safetensors.torch.save(tensors)
    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(folder / f"{stem}-{key}.scene") as unfinished, open(unfinished, "wb") as file:
                file.write(body)
                file.write(zlib.crc32(body).to_bytes(4, "little"))
        except (OSError, InputError):
            continue
        # What the pair looked like before is of no use any more, and a scene takes some 50 MB.
        for old in folder.glob("*.scene"):
            if old.name.startswith(f"{stem}-") and key not in old.name:
                old.unlink(missing_ok=True)
        return
