import sys

import numpy as np
import pytest
import torch
from onnx_files import FakeSession, Node, write_onnx
from refusals import expect_error

from pansplat.networks.relative_depth import RelativeDepthNetwork, load_relative_depth

_MEAN, _DEVIATION = np.array((0.485, 0.456, 0.406)), np.array((0.229, 0.224, 0.225))


def _channel_maximum(path, shape=(1, 3, "h", "w"), keep=0):
    """A file whose network returns the largest normalised channel."""
    write_onnx(path, shape, [Node("ReduceMax", ["image"], ["depth"], {"axes": [1], "keepdims": keep})])
    return path


@pytest.mark.parametrize(("shape", "size"), [((1, 3, "h", "w"), (518, 518)), ((1, 3, 28, 42), (28, 42))])
def test_network_of_a_file_sees_normalised_images_of_its_size(tmp_path, shape, size):
    pytest.importorskip("onnxruntime")
    network = load_relative_depth(_channel_maximum(tmp_path / "maximum.onnx", shape))
    assert network.size == size
    image = torch.rand((3, *size), generator=torch.Generator().manual_seed(0))
    expected = ((image.numpy().transpose(1, 2, 0) - _MEAN) / _DEVIATION).max(axis=-1)
    np.testing.assert_allclose(network(image), expected, atol=1e-5)


def test_fingerprint_changes_with_the_content_of_the_file(tmp_path):
    pytest.importorskip("onnxruntime")
    first = load_relative_depth(_channel_maximum(tmp_path / "a.onnx"))
    same = load_relative_depth(_channel_maximum(tmp_path / "b.onnx"))
    other = load_relative_depth(_channel_maximum(tmp_path / "a.onnx", (1, 3, 28, 28)))
    assert first.fingerprint == same.fingerprint != other.fingerprint


def test_missing_onnxruntime_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    expect_error(r"a\.onnx: .*pansplat\[onnx\]", lambda: load_relative_depth(_channel_maximum(tmp_path / "a.onnx")))


def test_file_that_is_no_network_is_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "text.onnx"
    path.write_text("no network")
    expect_error(r"text\.onnx: needed an ONNX network that contains its weights, got '", load_relative_depth, path)
    expect_error(r"none\.onnx: needed an ONNX file", load_relative_depth, tmp_path / "none.onnx")


def test_file_with_an_output_of_another_rank_is_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    network = load_relative_depth(_channel_maximum(tmp_path / "kept.onnx", (1, 3, 28, 28), keep=1))
    expect_error(r"kept\.onnx: .*\(1, 1, 28, 28\)", lambda: network(torch.zeros(3, 28, 28)))


IMAGE, MASK = ("image", "tensor(float)", (1, 3, 8, 8)), ("mask", "tensor(float)", (1, 1, 8, 8))


@pytest.mark.parametrize(
    "inputs",
    [
        [IMAGE, MASK],
        *([("image", "tensor(float)", shape)] for shape in ((3, 8, 8), (1, 4, 8, 8), (2, 3, 8, 8))),
        [("image", "tensor(uint8)", (1, 3, 8, 8))],
    ],
)
def test_other_inputs_are_refused_and_named(inputs):
    expect_error(r"net\.onnx: .* inputs image tensor", RelativeDepthNetwork, FakeSession(None, inputs), "net.onnx", "")


def _estimate(function, images):
    return RelativeDepthNetwork(FakeSession(function, [IMAGE]), "net.onnx", "").estimate(images)


def _fail(image):
    raise RuntimeError("Got invalid dimensions\nmore")


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda image: [np.full((1, 8, 8), np.nan)], "NaN"),
        (lambda image: [np.full((1, 8, 8), 3.0)], "constant"),
        (_fail, "invalid dimensions. .* 8x8"),
    ],
)
def test_a_failure_and_outputs_that_are_not_finite_or_all_constant_are_refused(function, message):
    expect_error(rf"net\.onnx: .*{message}", _estimate, function, torch.zeros(2, 3, 8, 8))


def test_a_constant_output_of_some_images_is_accepted():
    images = torch.stack((torch.zeros(3, 8, 8), torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0))))
    assert len(_estimate(lambda image: [image[:, 0]], images)) == 2
