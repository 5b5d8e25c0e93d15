"""Which backends can draw here is found out by trying."""

import pytest
import torch

from pansplat.bench.cases import Case
from pansplat.bench.drawing import draw, why_not
from pansplat.bench.scenes import full_lattice_room
from pansplat.errors import InputError

POSE = torch.eye(4, dtype=torch.float64)


def test_torch_and_the_dense_peer_draw_everywhere():
    assert why_not("torch") is None
    assert why_not("dense") is None


@pytest.mark.skipif(torch.cuda.is_available(), reason="asks what happens without CUDA")
@pytest.mark.parametrize("backend", ["triton", "gsplat"])
def test_without_cuda_its_renderers_say_so(backend):
    assert why_not(backend) == "there is no CUDA device"


def test_gsplat_is_missed_by_name_where_it_is_not_installed(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsplat", None)
    with pytest.raises(InputError, match="needs the package gsplat"):
        draw(Case("gsplat", 8, "ewa", "z", layout="cubemap", face_size=4), full_lattice_room(8), POSE)


def test_dense_and_torch_draw_the_same_picture():
    room = full_lattice_room(8)
    pictures = [draw(Case(backend, 8), room, POSE).color for backend in ("dense", "torch")]
    assert torch.allclose(*pictures, atol=1e-5)
