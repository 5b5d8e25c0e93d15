"""Weights on disk: round trips, refusals, checkpoints with code."""

import dataclasses
import os
import pickle
from pathlib import Path
from typing import Any, Literal

import pytest
import safetensors.torch
import torch
from refusals import expect_error

from pansplat.errors import InputError
from pansplat.networks.weights import (
    WeightsFile,
    config_from_dict,
    get_state_dict,
    load_weights,
    read_checkpoint,
    require_shapes,
    save_weights,
)


@dataclasses.dataclass(frozen=True)
class Inner:
    width: int = 8


@dataclasses.dataclass(frozen=True)
class Config:
    kind: Literal["a", "b"] = "a"
    sizes: tuple[int, ...] = (1, 2)
    inner: Inner = dataclasses.field(default_factory=Inner)
    several: tuple[Inner, ...] = (Inner(1), Inner(2))


class MaliciousObject:
    """An object whose unpickling runs a command that creates a file."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch '{self.mark}'",)


def make_weights() -> WeightsFile:
    tensors = {"a": torch.rand(3, 4).T, "count": torch.tensor(7)}  # the first is not contiguous
    return WeightsFile("pansplat", {"width": 3, "levels": [1, 2]}, "fixed", tensors)


def test_saved_weights_load_unchanged(tmp_path: Path) -> None:
    before = make_weights()
    save_weights(tmp_path / "w.safetensors", before)
    after = load_weights(tmp_path / "w.safetensors")
    assert (after.model, after.config, after.compat) == (before.model, before.config, before.compat)
    assert after.tensors.keys() == before.tensors.keys()
    assert all(torch.equal(after.tensors[name], tensor) for name, tensor in before.tensors.items())


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    expect_error("needed an existing folder", lambda: save_weights(tmp_path / "no" / "w.safetensors", make_weights()))
    expect_error(r"must end in \.safetensors, got '\.ckpt'", lambda: save_weights(tmp_path / "w.ckpt", make_weights()))
    assert not list(tmp_path.iterdir())


def test_weights_are_as_readable_as_other_files(tmp_path: Path) -> None:
    save_weights(tmp_path / "w.safetensors", make_weights())
    (tmp_path / "other").touch()
    assert (tmp_path / "w.safetensors").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_other_safetensors_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    safetensors.torch.save_file({"a": torch.zeros(1)}, path)
    expect_error("without their metadata; convert the official checkpoint", load_weights, path)
    metadata = {"pansplat_format": "99", "model": "pansplat", "config": "{}", "compat": "fixed"}
    safetensors.torch.save_file({"a": torch.zeros(1)}, path, metadata)
    expect_error("needed format 1 of weights files, got 99", load_weights, path)
    safetensors.torch.save_file({"a": torch.zeros(1)}, path, metadata | {"pansplat_format": "1", "config": "{"})
    expect_error("config: needed JSON", load_weights, path)
    safetensors.torch.save_file({"a": torch.zeros(1)}, path, metadata | {"pansplat_format": "1", "compat": "new"})
    expect_error("needed compat official or fixed in its metadata, got 'new'", load_weights, path)


def test_settings_are_restored_from_json() -> None:
    values = {"kind": "b", "sizes": [3, 4, 5], "inner": {"width": 2}, "several": [{"width": 5}]}
    assert config_from_dict(Config, values) == Config("b", (3, 4, 5), Inner(2), (Inner(5),))


def test_settings_of_another_version_are_refused() -> None:
    values = {"kind": "b", "sizes": [], "inner": {"width": 2}, "several": []}
    expect_error(r"unknown .*config\.extra", config_from_dict, Config, values | {"extra": 1})
    expect_error(r"unknown .*config\.inner\.wide", config_from_dict, Config, values | {"inner": {"wide": 1}})
    expect_error(r"config, kind: needed a known value, got 'c'", config_from_dict, Config, values | {"kind": "c"})


@pytest.mark.parametrize("zipped", [True, False])
def test_a_checkpoint_is_read(tmp_path: Path, zipped: bool) -> None:
    path = tmp_path / "good.ckpt"
    tensor = torch.rand(5)
    torch.save({"state_dict": {"a": tensor}}, path, _use_new_zipfile_serialization=zipped)
    assert torch.equal(get_state_dict(read_checkpoint(path), path)["a"], tensor)


@pytest.mark.parametrize("zipped", [True, False])
def test_code_in_a_checkpoint_is_refused_and_not_executed(tmp_path: Path, zipped: bool) -> None:
    mark, path = tmp_path / "executed", tmp_path / "malicious.ckpt"
    torch.save({"state_dict": {}, "callback": MaliciousObject(mark)}, path, _use_new_zipfile_serialization=zipped)
    expect_error(r"calls (posix|nt)\.system; the call was not executed", read_checkpoint, path)
    assert not mark.exists()
    torch.load(path, weights_only=False)  # this executes the command
    assert mark.exists()


def test_code_in_a_pickle_is_refused_and_not_executed(tmp_path: Path) -> None:
    mark, path = tmp_path / "executed", tmp_path / "malicious.ckpt"
    path.write_bytes(pickle.dumps(MaliciousObject(mark)))
    expect_error("malicious", read_checkpoint, path)
    assert not mark.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"<!DOCTYPE html><html><body>OneDrive</body></html>", "it is a web page: download the file itself"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "run `git lfs pull`"),
        (b"hello\n" * 50, r"wrong\.ckpt: needed a .*PyTorch checkpoint, got .* again"),
        (b"", "got an empty file"),
    ],
)
def test_what_is_no_checkpoint_is_recognised(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "wrong.ckpt").write_bytes(content)
    expect_error(message, read_checkpoint, tmp_path / "wrong.ckpt")


def test_a_checkpoint_without_tensors_by_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.ckpt"
    torch.save(torch.rand(3), path)
    expect_error("needed a checkpoint with a `state_dict`, got a Tensor", read_checkpoint, path)
    expect_error("got one with model, epoch", get_state_dict, {"model": {}, "epoch": 1}, path)
    expect_error("other values at b", lambda: get_state_dict({"state_dict": {"a": torch.rand(1), "b": 3}}, path))


def test_wrong_shapes_are_named() -> None:
    needed = {"a": torch.zeros(2, 3), "b": torch.zeros(1)}
    with pytest.raises(InputError, match=r"got 1 \(a \(3, 2\) instead of \(2, 3\)\)"):
        require_shapes({"a": torch.zeros(3, 2), "b": torch.zeros(1)}, needed, "x")
    with pytest.raises(InputError, match=r"lacked 1 \(b\); found unknown 1 \(c\)"):
        require_shapes({"a": torch.zeros(2, 3), "c": torch.zeros(1)}, needed, "x")
    require_shapes(needed, needed, "x")
