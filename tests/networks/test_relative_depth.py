import sys

import numpy as np
import pytest
import torch
from onnx_files import FakeSession, Node, write_onnx
from refusals import expect_error

from pansplat.errors import InputError
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


@pytest.mark.parametrize(
    "inputs",
    [
        [("image", "tensor(float)", (1, 3, 8, 8)), ("mask", "tensor(float)", (1, 1, 8, 8))],
        [("image", "tensor(float)", (3, 8, 8))],
        [("image", "tensor(float)", (1, 4, 8, 8))],
        [("image", "tensor(float)", (2, 3, 8, 8))],
        [("image", "tensor(uint8)", (1, 3, 8, 8))],
    ],
)
def test_other_inputs_are_refused_and_named(inputs):
    with pytest.raises(InputError, match=r"net\.onnx: .* inputs image tensor"):
        RelativeDepthNetwork(FakeSession(None, inputs), "net.onnx", "")


def _network(function):
    return RelativeDepthNetwork(FakeSession(function, [("image", "tensor(float)", (1, 3, 8, 8))]), "net.onnx", "")


def test_output_that_is_not_finite_is_refused():
    with pytest.raises(InputError, match=r"net\.onnx: .* NaN"):
        _network(lambda image: [np.full((1, 8, 8), np.nan)])(torch.zeros(3, 8, 8))


def test_failure_of_the_network_is_named():
    def fail(image):
        raise RuntimeError("Got invalid dimensions\nmore")

    expect_error(r"net\.onnx: .*invalid dimensions. .* 8x8", lambda: _network(fail)(torch.zeros(3, 8, 8)))


def test_constant_output_of_all_images_is_refused_and_of_some_accepted():
    images = torch.zeros(2, 3, 8, 8)
    expect_error(r"net\.onnx: .* constant", lambda: _network(lambda image: [np.full((1, 8, 8), 3.0)]).estimate(images))
    images[1] = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0))
    assert len(_network(lambda image: [image[:, 0]]).estimate(images)) == 2
