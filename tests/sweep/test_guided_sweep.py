import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_card import CARD, pretend_card
from onnx_files import Node, write_onnx
from refusals import expect_error

from pansplat.evaluation.metrics import ws_psnr
from pansplat.networks.depth_network import DepthNetworkConfig
from pansplat.networks.depth_refinement import DepthRefinement, RefinementConfig
from pansplat.networks.depth_sharpening import DepthSharpening, SharpeningConfig
from pansplat.networks.weights import pack_weights, save_weights
from pansplat.pipeline import load_model, load_predictor, load_sets, predict, render
from pansplat.prediction_options import PredictOptions
from pansplat.sweep.guided_sweep import NetworkPrior, default_weights, load_guided_sweep, save_network
from pansplat.sweep.panoramas import resize_sphere

_OF_A_VIEW = ("images", "masks", "cam2world")
_CONFIG = RefinementConfig(
    mono=DepthNetworkConfig(room_channels=24, attention_layers=1, attention_heads=3, decoder_channels=(16, 12, 8, 8)),
    candidates=9,
    matching_channels=4,
    channels=(8, 12, 16),
)


def _network(seed=0):
    torch.manual_seed(seed)
    network = DepthRefinement(_CONFIG)
    for head in (network.head, network.mono.head):
        torch.nn.init.normal_(head.weight, std=0.1)
    return network.eval()


def _sharpening():
    return DepthSharpening(SharpeningConfig(24, 1, 3, (16, 12, 8, 8), 64, 8)).eval()


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "depth.safetensors"
    network = _network()
    save_network(path, network, network.state_dict())
    return path


def _images(views=2, height=64):
    return np.random.default_rng(0).random((views, height, 2 * height, 3), np.float32)


def test_saved_network_estimates_the_same_depth(weights):
    loaded, network = load_guided_sweep(weights), NetworkPrior(lambda: (_network(), _sharpening()), "", 64)
    assert isinstance(loaded.prior, NetworkPrior)
    loaded.prior.height = 64
    first, second = (prior.observe(_images()).priors for prior in (loaded.prior, network))
    assert first[0].log_depth.shape == (32, 64)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a.log_depth, b.log_depth, atol=5e-3)
        np.testing.assert_allclose(a.scale, b.scale, rtol=2e-2)


def test_sharpened_depth_has_the_networks_size_and_the_views_order():
    observed = NetworkPrior(lambda: (_network(), _sharpening()), "", 64).observe(_images())
    both = observed.sharpen()
    assert [log_depth.shape for log_depth in both] == [(64, 128)] * 2
    estimates = [prior.log_depth.ravel() for prior in observed.priors]
    for view, log_depth in enumerate(both):  # an untrained network smooths the estimate
        small = resize_sphere(log_depth, 32).ravel()
        own, other = (np.corrcoef(small, estimates[n])[0, 1] for n in (view, 1 - view))
        assert own > 0.3 and abs(other) < 0.5 * own


def test_networks_on_a_card_estimate_what_those_on_the_processor_do(monkeypatch):
    prior, poses = NetworkPrior(lambda: (_network(), _sharpening()), "", 64), np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.5

    def estimate():
        observed = prior.observe(_images())
        refined = observed.refine(observed.priors, poses, [[1], [0]], 1)
        return [prior.log_depth for prior in (*observed.priors, *refined)] + observed.sharpen()

    expected = estimate()
    monkeypatch.setattr("pansplat.sweep.guided_sweep.choose_device", lambda *_: CARD)
    with pretend_card() as count:
        got = estimate()
    assert count["copies"] and not any("mixed" in name for name in count if count[name])
    for first, second in zip(expected, got, strict=True):
        np.testing.assert_allclose(second, first, atol=1e-4)
    assert {weight.device.type for weight in prior.networks[0].parameters()} == {"cpu"}, "which other threads use"


def test_the_shipped_networks_are_read_when_they_are_needed_first():
    """Scenes in the cache need their fingerprint only."""
    assert "networks" not in vars(load_guided_sweep(default_weights()).prior)


def test_fingerprint_depends_on_the_weights(weights, tmp_path):
    other = _network(1)
    save_network(tmp_path / "other.safetensors", other, other.state_dict())
    fingerprints = {load_guided_sweep(path).fingerprint for path in (weights, tmp_path / "other.safetensors")}
    fingerprints.add(load_model("sweep").fingerprint)
    assert len(fingerprints) == 3


def test_other_weights_are_refused(tmp_path):
    path = tmp_path / "other.safetensors"
    save_weights(path, pack_weights("pansplat", _CONFIG, {"a": torch.zeros(1)}, compat="fixed"))
    expect_error(r"needed weights of a depth network, got weights of 'pansplat'", load_guided_sweep, path)


@pytest.mark.slow
def test_shipped_model_estimates_the_sample_within_a_fifth():
    (pair,) = load_sets(Path(__file__).parents[2] / "assets" / "living_room")
    views = pair.load_context(128)
    images = [image.permute(1, 2, 0).numpy() for image in views.images]
    observed = load_model("default").prior.observe(images)
    depth = views.depths[:, ::2, ::2].numpy()
    for prior, true in zip(observed.priors, depth, strict=True):
        error = prior.log_depth - np.log(true)
        assert np.abs(error - np.median(error)).mean() < 0.2


@pytest.fixture(scope="module")
def sample():
    (pair,) = load_sets(Path(__file__).parents[2] / "assets" / "living_room")
    return pair.load_context(64), pair.load_targets(64), load_model("default")


def _error_between(sample, **changes):
    """Error of the middle view, drawn from a prediction with other inputs, dB."""
    views, targets, model = sample
    views = dataclasses.replace(views, **changes)
    middle = render(predict(views, model), targets.cam2world[0], size=(64, 128)).color
    return ws_psnr(middle.clamp(0, 1), targets.images[0])


@pytest.mark.slow
def test_errors_of_poses_and_depth_range_cost_little(sample):
    views, exact = sample[0], _error_between(sample)
    poses, angle = views.cam2world.clone(), math.radians(0.3)
    poses[1, :3, :3] @= torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]], dtype=poses.dtype
    )
    poses[1, :3, 3] += torch.tensor([0.01, -0.01, 0.014], dtype=poses.dtype)  # 2 cm
    assert _error_between(sample, cam2world=poses) > exact - 0.5  # 1.46 for errors four times as large
    assert _error_between(sample, near=views.near / 2, far=2 * views.far) > exact - 0.5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:left, right. the cameras are at one place")
def test_coincident_cameras_give_a_scene_that_is_better_than_a_sphere(sample, sphere_predictor):
    views, targets, _ = sample
    same = {name: getattr(views, name)[:1].repeat(2, *[1] * (getattr(views, name).ndim - 1)) for name in _OF_A_VIEW}
    sphere = predict(dataclasses.replace(views, **same), sphere_predictor())
    drawn = render(sphere, targets.cam2world[0], size=(64, 128)).color.clamp(0, 1)
    assert _error_between(sample, **same) > ws_psnr(drawn, targets.images[0]) + 2


def _write_depth_network(path, channel=0):
    """A network whose inverse depth is a channel of the image."""
    constants = {"channel": np.array(channel, np.int64)}
    write_onnx(path, (1, 3, 28, 28), [Node("Gather", ["image", "channel"], ["depth"], {"axis": 1})], constants)
    return path


def test_depth_network_replaces_the_sharpening_network(weights, tmp_path):
    """The surface has the edges of the red channel, which is the network's inverse depth."""
    pytest.importorskip("onnxruntime")
    prior = load_guided_sweep(weights, "depth", _write_depth_network(tmp_path / "red.onnx")).prior
    torch.nn.init.zeros_(prior.networks[0].mono.head.weight)  # an estimate of one distance
    images = np.full((2, 64, 128, 3), 0.2, np.float32)
    images[0, 20:44, :30, 0], images[1, 20:44, 60:90, 0] = 0.8, 0.8
    for image, log_depth in zip(images, prior.observe(images).sharpen(), strict=True):
        assert log_depth.shape == (64, 128)
        assert np.corrcoef(log_depth[4:-4].ravel(), image[4:-4, :, 0].ravel())[0, 1] < -0.5


def test_fingerprint_depends_on_the_content_of_the_depth_network(weights, tmp_path):
    pytest.importorskip("onnxruntime")
    path = _write_depth_network(tmp_path / "net.onnx")
    first = load_model(weights, depth_network=path)
    same = load_model(weights, depth_network=str(_write_depth_network(tmp_path / "copy.onnx")))
    other = load_model(weights, depth_network=_write_depth_network(path, 1))
    fingerprints = [model.fingerprint for model in (first, other, load_model(weights))]
    assert first.fingerprint == same.fingerprint and len(set(fingerprints)) == 3
    shipped = load_model(depth_network=path)
    assert shipped.name == "default" and shipped.fingerprint != load_model().fingerprint
    assert load_predictor(PredictOptions(depth_network=path)).fingerprint == shipped.fingerprint


def test_depth_network_is_refused_by_models_without_a_depth_network(tmp_path):
    path = tmp_path / "other.safetensors"
    save_weights(path, pack_weights("pansplat", _CONFIG, {"a": torch.zeros(1)}, compat="fixed"))
    for name in ("sweep", path):
        expect_error("`depth_network` is for", load_model, name, depth_network=tmp_path / "net.onnx")
