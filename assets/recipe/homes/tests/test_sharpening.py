import dataclasses

import numpy as np
import pytest
import torch

from pansplat.networks.depth_network import DepthEstimate
from pansplat.networks.depth_sharpening import DepthSharpening, SharpeningConfig
from pansplat.sweep.guided_sweep import load_network
from pansplat.training.logs import read_table
from pansplat_homes import shards
from pansplat_homes.shards import Tour
from pansplat_homes.sharpening import (
    SharpeningTrainConfig,
    SharpeningTrainer,
    sharpening_loss,
    start_from_depth_network,
)

_NETWORK = SharpeningConfig(
    height=64,
    room_channels=24,
    attention_layers=1,
    attention_heads=3,
    decoder_channels=(16, 12, 8, 8),
    selection_channels=8,
)


@pytest.fixture
def config(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "TOURS_PER_SHARD", 2)
    generator, poses = np.random.default_rng(0), np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1.0
    light = generator.uniform(0.1, 0.3, (2, 64, 128, 3)).astype(np.float32)
    tour = Tour(light, generator.uniform(1, 3, (2, 64, 128)).astype(np.float32), poses, np.array((1.5, 1.4)))
    shards._save_shard(tmp_path / "shard_00000.npz", (tour, tour))
    return SharpeningTrainConfig(
        out=tmp_path / "run", tours=(tmp_path,), validation=tmp_path, steps=3, decay_steps=1, warm_up=1,
        validate_every=3, validation_tours=1, network=_NETWORK,
    )  # fmt: skip


@pytest.mark.exhaustive
def test_a_run_resumes_and_its_weights_are_read(config):
    assert not SharpeningTrainer(dataclasses.replace(config, stop_after_minutes=1e-9), silent=True).train()
    trainer = SharpeningTrainer(config, silent=True)
    assert trainer.step == 1
    assert trainer.train()
    weights = load_network(config.out / "model.safetensors", DepthSharpening)
    assert weights.config == _NETWORK
    assert [row["step"] for row in read_table(config.out / "validation.csv")] == ["3"]
    other = SharpeningTrainer(dataclasses.replace(config, out=config.out / "b", init=config.out / "model.safetensors"))
    np.testing.assert_array_equal(other.network.mask.weight.detach(), weights.mask.weight.detach())


def test_true_depth_has_no_error_and_unknown_pixels_do_not_count():
    depth = torch.rand(1, 32, 64) + 1
    half = DepthEstimate(depth[:, ::2, ::2].log(), torch.zeros(1, 16, 32))
    exact = sharpening_loss(depth.log(), half, depth)
    assert all(float(term) == 0 for term in exact.values())
    unknown = depth.clone()
    unknown[:, 8:16] = 0
    wrong = depth.log()
    wrong[:, 8:16] = 5
    assert float(sharpening_loss(wrong, half, unknown)["loss"]) == 0
    shifted = sharpening_loss(depth.log() + 0.5, half, depth)
    assert float(shifted["error"]) == pytest.approx(0.5) and float(shifted["differences"]) < 1e-6


def test_the_network_starts_with_the_depth_networks_features():
    network = DepthSharpening(_NETWORK)
    weights = {name: torch.ones_like(value) for name, value in network.state_dict().items() if "encoder." in name}
    shape = network.decoder[0].conv1.weight.shape
    weights["decoder.0.conv1.weight"] = torch.ones(shape[0], shape[1] - 3, *shape[2:])
    start_from_depth_network(network, weights)
    assert bool((network.encoder.stem.weight == 1).all())
    assert bool((network.decoder[0].conv1.weight[:, :-3] == 1).all())
    assert bool((network.decoder[0].conv1.weight[:, -3:] == 0).all())
