"""Weights on disk: they come back as they went, and nothing that a checkpoint holds is run."""

import dataclasses
import os
import pickle
from pathlib import Path
from typing import Any, Literal

import pytest
import safetensors.torch
import torch

from pansplat.errors import InputError
from pansplat.model.weights import (
    WeightsFile,
    config_from_dict,
    load_weights,
    read_checkpoint,
    save_weights,
    state_dict_of,
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


class Poison:
    """Runs a command when it is unpickled: it makes a file."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch '{self.mark}'",)


def weights() -> WeightsFile:
    tensors = {"a": torch.rand(3, 4).T, "count": torch.tensor(7)}  # one of them not contiguous
    return WeightsFile("pansplat", {"width": 3, "levels": [1, 2]}, "fixed", tensors)


# Our files


def test_weights_come_back_as_they_went(tmp_path: Path) -> None:
    before = weights()
    save_weights(tmp_path / "w.safetensors", before)
    after = load_weights(tmp_path / "w.safetensors")
    assert (after.model, after.config, after.compat) == (before.model, before.config, before.compat)
    assert after.tensors.keys() == before.tensors.keys()
    assert all(torch.equal(after.tensors[name], tensor) for name, tensor in before.tensors.items())


def test_nothing_is_left_of_a_file_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needed an existing folder"):
        save_weights(tmp_path / "no" / "w.safetensors", weights())
    with pytest.raises(InputError, match=r"must end in \.safetensors, got '\.ckpt'"):
        save_weights(tmp_path / "w.ckpt", weights())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kept", [0, 5, 40, 0.5, 0.99])
def test_a_truncated_weights_file_is_refused(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "w.safetensors"
    save_weights(path, weights())
    content = path.read_bytes()
    path.write_bytes(content[: kept if isinstance(kept, int) else int(kept * len(content))])
    with pytest.raises(InputError, match=r"w\.safetensors: needed .* again"):
        load_weights(path)


def test_weights_of_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    safetensors.torch.save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(InputError, match="without their metadata; convert the original checkpoint"):
        load_weights(path)
    metadata = {"pansplat_format": "99", "model": "pansplat", "config": "{}", "compat": "fixed"}
    safetensors.torch.save_file({"a": torch.zeros(1)}, path, metadata)
    with pytest.raises(InputError, match="needed format 1 of weights files, got 99"):
        load_weights(path)
    safetensors.torch.save_file({"a": torch.zeros(1)}, path, metadata | {"pansplat_format": "1", "config": "{"})
    with pytest.raises(InputError, match="needed settings in its metadata"):
        load_weights(path)
    safetensors.torch.save_file({"a": torch.zeros(1)}, path, metadata | {"pansplat_format": "1", "compat": "new"})
    with pytest.raises(InputError, match="needed settings in its metadata, got 'new'"):
        load_weights(path)


# Settings


def test_settings_come_back_through_json() -> None:
    values = {"kind": "b", "sizes": [3, 4, 5], "inner": {"width": 2}, "several": [{"width": 5}]}
    assert config_from_dict(Config, values) == Config("b", (3, 4, 5), Inner(2), (Inner(5),))


def test_settings_of_another_version_are_refused() -> None:
    values = {"kind": "b", "sizes": [], "inner": {"width": 2}, "several": []}
    with pytest.raises(InputError, match=r"config: .* unknown \['extra'\] and lacked \[\]"):
        config_from_dict(Config, values | {"extra": 1})
    with pytest.raises(InputError, match=r"config\.inner: .* unknown \['wide'\] and lacked \['width'\]"):
        config_from_dict(Config, values | {"inner": {"wide": 1}})
    with pytest.raises(InputError, match=r"config\.kind: needed one of \('a', 'b'\), got 'c'"):
        config_from_dict(Config, values | {"kind": "c"})


# Checkpoints


@pytest.mark.parametrize("zipped", [True, False])
def test_a_checkpoint_is_read(tmp_path: Path, zipped: bool) -> None:
    path = tmp_path / "good.ckpt"
    tensor = torch.rand(5)
    torch.save({"state_dict": {"a": tensor}}, path, _use_new_zipfile_serialization=zipped)
    assert torch.equal(state_dict_of(read_checkpoint(path), path)["a"], tensor)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_poisoned_checkpoint_is_refused_and_not_run(tmp_path: Path, zipped: bool) -> None:
    mark, path = tmp_path / "was run", tmp_path / "poisoned.ckpt"
    torch.save({"state_dict": {}, "callback": Poison(mark)}, path, _use_new_zipfile_serialization=zipped)
    with pytest.raises(InputError, match=r"asks to run (posix|nt)\.system; nothing was run"):
        read_checkpoint(path)
    assert not mark.exists()
    torch.load(path, weights_only=False)  # the poison would have worked
    assert mark.exists()


def test_a_poisoned_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    mark, path = tmp_path / "was run", tmp_path / "poisoned.ckpt"
    path.write_bytes(pickle.dumps(Poison(mark)))
    with pytest.raises(InputError, match="poisoned"):
        read_checkpoint(path)
    assert not mark.exists()


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.95])
def test_a_truncated_checkpoint_is_refused(tmp_path: Path, kept: float, zipped: bool) -> None:
    path = tmp_path / "short.ckpt"
    torch.save({"state_dict": {"a": torch.rand(5000)}}, path, _use_new_zipfile_serialization=zipped)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputError, match=r"short\.ckpt: needed a whole PyTorch checkpoint, got a damaged one"):
        read_checkpoint(path)


@pytest.mark.parametrize("content", [b"hello\n" * 50, bytes(3000), bytes(range(256)) * 9])
def test_a_file_of_something_else_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "wrong.ckpt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"wrong\.ckpt: needed a .*PyTorch checkpoint, got .* again"):
        read_checkpoint(path)


def test_a_web_page_and_a_pointer_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "wrong.ckpt"
    path.write_bytes(b"<!DOCTYPE html><html><body>OneDrive</body></html>")
    with pytest.raises(InputError, match="it is a web page: download the file itself"):
        read_checkpoint(path)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    with pytest.raises(InputError, match="run `git lfs pull`"):
        read_checkpoint(path)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="got nothing there"):
        read_checkpoint(tmp_path / "none.ckpt")
    with pytest.raises(InputError, match="got a folder"):
        read_checkpoint(tmp_path)
    (tmp_path / "empty.ckpt").touch()
    with pytest.raises(InputError, match="got an empty file"):
        read_checkpoint(tmp_path / "empty.ckpt")


def test_a_checkpoint_without_tensors_by_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.ckpt"
    torch.save(torch.rand(3), path)
    with pytest.raises(InputError, match="needed a checkpoint with a `state_dict`, got a Tensor"):
        read_checkpoint(path)
    with pytest.raises(InputError, match="got one with model, epoch"):
        state_dict_of({"model": {}, "epoch": 1}, path)
    with pytest.raises(InputError, match="needed a `state_dict` of tensors, got others at b"):
        state_dict_of({"state_dict": {"a": torch.rand(1), "b": 3}}, path)
