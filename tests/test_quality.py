"""Pictures of the default model are as good as they were: the sample at 256 rows, of both photographs and of one.

Two threads, one, and two with `NUMBA_CPU_NAME=generic ATEN_CPU_CAPABILITY=avx2` gave the spread below. Bounds are
ten times as far away, as other processors round otherwise; differences below .1 dB are noise for the eye.
"""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import pansplat
from pansplat.evaluation.lpips import load_lpips
from pansplat.evaluation.metrics import ws_psnr

SPREAD_DB, SPREAD_LPIPS = 0.0016, 0.00012


@pytest.mark.parametrize(("views", "psnr", "lpips"), [(2, 25.631, 0.1096), (1, 21.363, 0.1196)])
def test_pictures_of_the_sample_are_as_good_as_they_were(shared: Path, views: int, psnr: float, lpips: float) -> None:
    (pair,) = pansplat.load_sets(Path(__file__).resolve().parents[1] / "assets" / "living_room")
    given, target = pair.load_context(256), pair.load_targets(256)
    fields = {name: getattr(given, name)[:views] for name in ("images", "cam2world", "masks", "names")}
    scene = pansplat.predict(replace(given, **fields))
    picture = pansplat.render(scene, target.cam2world[0]).color.float()
    with torch.no_grad():
        distance = float(load_lpips("squeeze", shared / "weights").distance(picture, target.images[0].float()))
    assert ws_psnr(picture, target.images[0]) > psnr - 10 * SPREAD_DB
    assert distance < lpips + 10 * SPREAD_LPIPS
