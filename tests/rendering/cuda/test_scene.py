"""The paper's network and `pansplat.render` on a GPU, against the same on the processor."""

import dataclasses

import pytest
import torch
from dense_renderer import POSE, make_scene

from pansplat.gaussians.scene import Scene
from pansplat.model.network import build_network
from pansplat.model.pansplat import PanSplat
from pansplat.networks.weights import load_weights
from pansplat.pipeline import render

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


@torch.no_grad()
def test_the_network_predicts_on_a_gpu_what_it_predicts_on_the_processor(tmp_path):
    from pansplat.bench.model import save_random_weights

    save_random_weights(tmp_path / "model.safetensors")
    weights = load_weights(tmp_path / "model.safetensors")
    network = build_network(weights, "fixed", "model", precision="float32", attention_precision="float32").eval()
    assert isinstance(network, PanSplat)
    images = torch.rand(1, 2, 3, 128, 256, generator=torch.Generator().manual_seed(0))
    poses = torch.eye(4).repeat(1, 2, 1, 1)
    poses[0, 1, 0, 3] = 1.0
    near, far = torch.full((1, 2), 0.5), torch.full((1, 2), 20.0)
    expected = network.match_views(images, poses, near, far).depths.depth[-1]
    on_gpu = (value.cuda() for value in (images, poses, near, far))
    got = network.cuda().match_views(*on_gpu).depths.depth[-1].cpu()
    assert float(((got - expected).abs() / expected).median()) < 1e-5


def test_a_scene_is_rendered_on_a_gpu_as_on_the_processor():
    gaussians = make_scene(40, scale=0.3, degree=1).to(dtype=torch.float32)
    gaussians = dataclasses.replace(gaussians, views=torch.arange(40) % 2)
    cameras = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    cameras[1, 0, 3] = 0.5
    scene = Scene(gaussians, cameras, 0.05, 10.0, height=32)
    expected = render(scene, POSE)
    got = render(dataclasses.replace(scene, gaussians=gaussians.to(device="cuda")), POSE)
    assert got.color.is_cuda and float((got.color.cpu() - expected.color).abs().max()) < 1e-4
