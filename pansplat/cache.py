"""The cache of predictions on disk, keyed by a hash of all inputs."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors.torch
import torch

from pansplat.gaussians.scene import Gains, Gaussians, Scene
from pansplat.inputs.pairs import Pair
from pansplat.inputs.views import Views
from pansplat.prediction_options import PredictOptions
from pansplat.predictor import Predictor
from pansplat.refinement import RefineConfig, RefineReport, refinement_fingerprint
from pansplat.system.cache_folders import cache_folders, write_cache_file
from pansplat.system.files import read_file

_MAX_LEVELS = 256  # of Gaussians; their labels are bytes
_FORMAT = "1"  # version of the file's layout; part of the hash
_GAINS, _REFINEMENT = "gains", "refinement"
_ENOUGH_STEPS = 40  # of a refinement; more change little
_STARVED_SHARE = 1 / 3  # of the processor's threads, below which a refinement of fewer steps is starved by load
_FIELDS = tuple(field.name for field in dataclasses.fields(Gaussians))


class CachedScene(NamedTuple):
    """Content of a file.

    Attributes:
        gaussians, gains: see `Scene`.
        steps: of the refinement; 0 for a prediction.
        is_starved: whether the refinement did few steps because other processes had the processor.
    """

    gaussians: Gaussians
    gains: Gains = ()
    steps: int = 0
    is_starved: bool = False


class CachedPrediction:
    """The file of one prediction, or of its refinement: safetensors, followed by a CRC-32.

    The file is in `.pansplat/` in the pair's folder, or in the user's cache folder if that is not writable. Its name
    contains a hash of the decoded pixels, masks, poses, depth range, the predictor's fingerprint, and for a refinement
    of its options. There is no file of loaded panoramas, and without `PredictOptions.cache`.
    """

    def __init__(
        self, source: Pair | Views, views: Views, predictor: Predictor, options: PredictOptions, *, refined: bool
    ) -> None:
        self._folders, self._found = list[Path](), None
        if not isinstance(source, Pair) or not options.cache:
            return
        self._folders = list_cache_folders(source)
        self._num_views = len(views.images)
        model = predictor.name + ("_refined" if refined else "")
        self._stem = f"{_make_file_name(source.name)}-{_make_file_name(model)}-{options.height}-"
        self._name = f"{self._stem}{_hash_inputs(views, predictor, options if refined else None)}.scene"

    def read(self) -> CachedScene | None:
        """Content of the first undamaged file; None if there is none."""
        found = (_read_scene(folder / self._name, self._num_views) for folder in self._folders)
        self._found = next((content for content in found if content is not None), None)
        return self._found

    def write_refinement(self, scene: Scene, report: RefineReport, processor_seconds: float) -> CachedScene:
        """Write a refinement, or what `read` has found if that has more steps; returns what is written.

        A refinement of few steps that shared the processor with other work is starved: it is to be run once more.
        """
        found, share = self._found, processor_seconds / (report.seconds * torch.get_num_threads())
        is_short = report.stopped == "done" and report.steps < _ENOUGH_STEPS and share < _STARVED_SHARE
        content = CachedScene(scene.gaussians, scene.gains, report.steps, is_short and found is None)
        if found is not None and found.steps > report.steps:
            content = found._replace(is_starved=False)
        self.write(content)
        return content

    def write(self, content: CachedScene) -> None:
        """Write to the first writable folder, if any, and delete outdated predictions there."""
        if not self._folders:
            return
        tensors = {name: getattr(content.gaussians, name).detach().cpu().contiguous() for name in _FIELDS}
        if content.gains:
            tensors[_GAINS] = torch.tensor(content.gains, dtype=torch.float64)
        if content.steps:
            tensors[_REFINEMENT] = torch.tensor((content.steps, content.is_starved))
        body = safetensors.torch.save(tensors)
        written = write_cache_file(self._folders, self._name, body, zlib.crc32(body).to_bytes(4, "little"))
        for old in [] if written is None else written.parent.glob("*.scene"):
            if old.name.startswith(self._stem) and old.name != self._name:
                old.unlink(missing_ok=True)


def list_cache_folders(pair: Pair) -> list[Path]:
    """Folders for a pair's predictions, in order of preference."""
    return cache_folders(pair.folder)


def _hash_inputs(views: Views, predictor: Predictor, refinement: PredictOptions | None) -> str:
    # Pixels are hashed, not files: a mask may depend on other panoramas of the folder, and a decoder may change.
    digest = hashlib.blake2b(digest_size=16)
    settings = [_FORMAT, list(views.images.shape), views.near, views.far, predictor.name, predictor.fingerprint]
    if refinement is not None:
        fingerprint = refinement_fingerprint(RefineConfig(gaussians=refinement.gaussians))
        settings += [f"{fingerprint}-{refinement.refine_seconds:g}s" + ("-joint" if refinement.joint else "")]
    digest.update(json.dumps(settings).encode())
    for tensor in (views.images, views.cam2world.double(), views.masks):
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy()).data)
    return digest.hexdigest()


def _read_scene(path: Path, num_views: int) -> CachedScene | None:
    """The content of a file; None if it is missing, damaged, or holds values that no predictor writes."""
    try:
        content = read_file(path)
        body, checksum = content[:-4], int.from_bytes(content[-4:], "little")
        if zlib.crc32(body) != checksum:
            return None
        tensors = safetensors.torch.load(body)
        gaussians = Gaussians(*(tensors[name] for name in _FIELDS))
        gains = tensors.get(_GAINS, torch.zeros(0))
        steps, is_starved = tensors.get(_REFINEMENT, torch.zeros(2)).tolist()
    except (OSError, ValueError, KeyError, safetensors.SafetensorError):
        return None
    floats = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.harmonics)
    labels = (gaussians.levels, gaussians.views)
    if not all(value.dtype in (torch.float32, torch.float64) and bool(value.isfinite().all()) for value in floats):
        return None
    if any(label.is_floating_point() or label.is_complex() or label.dtype == torch.bool for label in labels):
        return None
    for label, count in zip(labels, (_MAX_LEVELS, num_views), strict=True):
        if len(label) and not 0 <= int(label.min()) <= int(label.max()) < count:
            return None
    is_valid = gains.dtype == torch.float64 and gains.shape == (num_views, 3) and bool((gains > 0).all())
    if gains.numel() and not (is_valid and bool(gains.isfinite().all())):
        return None
    return CachedScene(gaussians, tuple(map(tuple, gains.tolist())), int(steps), bool(is_starved))


def _make_file_name(name: str) -> str:
    """The name in ASCII and short; with a hash if that changes it, so that different names stay different."""
    plain = re.sub(r"[^A-Za-z0-9_.]+", "_", name)[:60]
    return plain if plain == name else f"{plain}-{hashlib.blake2b(os.fsencode(name), digest_size=4).hexdigest()}"
