"""Pictures of the default model are as good as they were: the sample, by both photographs and by one, and a flight.

Each case was measured at 256 rows with two threads and with one, also where numba, torch and oneDNN use no AVX-512
(`NUMBA_CPU_NAME=generic ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2`): the largest differences are the spread.
Bounds are ten times as far away, because other processors and libraries round otherwise.
"""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import pansplat
from pansplat.evaluation.lpips import load_lpips
from pansplat.evaluation.metrics import ws_psnr

SPREAD_DB, SPREAD_LPIPS = 0.0063, 0.0005
ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "assets" / "living_room"
FLIGHT = ROOT / "tests" / "assets" / "flight"  # the fourth of `pansplat-homes flights --height 256`, half-way


@pytest.mark.parametrize(
    ("folder", "views", "psnr", "lpips"),
    [(SAMPLE, 2, 25.632, 0.1096), (SAMPLE, 1, 21.362, 0.1197), (FLIGHT, 2, 21.356, 0.1911)],
    ids=["sample", "single photograph", "flight"],
)
def test_pictures_are_as_good_as_they_were(shared: Path, folder: Path, views: int, psnr: float, lpips: float) -> None:
    (panoramas,) = pansplat.load_sets(folder)
    given, target = panoramas.load_context(256), panoramas.load_targets(256)
    fields = {name: getattr(given, name)[:views] for name in ("images", "cam2world", "masks", "names")}
    scene = pansplat.predict(replace(given, **fields))
    picture = pansplat.render(scene, target.cam2world[0]).color.float()
    with torch.no_grad():
        distance = float(load_lpips("squeeze", shared / "weights").distance(picture, target.images[0].float()))
    assert ws_psnr(picture, target.images[0]) > psnr - 10 * SPREAD_DB
    assert distance < lpips + 10 * SPREAD_LPIPS


def test_the_refinement_of_the_sample_is_kept_and_shows_its_detail() -> None:
    """Against 512 rows, 40 steps of layers gain 2.6 dB; half of that is asked."""
    (panoramas,) = pansplat.load_sets(SAMPLE)
    target, errors = panoramas.load_targets(512), []
    for steps in (0, 40):
        scene = pansplat.predict(panoramas, height=256, refine_steps=steps, joint=False, cache=False)
        picture = pansplat.render(scene, target.cam2world[0], size=(512, 1024)).color.float()
        errors.append(float(ws_psnr(picture, target.images[0])))
    assert errors[1] - errors[0] > 1.3
