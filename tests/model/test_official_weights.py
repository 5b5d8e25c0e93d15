"""Conversion of the weights of official checkpoints."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import expect_error
from torch import Tensor

from pansplat.errors import InputError
from pansplat.model.official_weights import convert_tensors, match_tensors

Wrap = Callable[[dict[str, Tensor]], dict[str, Any]]


def list_names(shared: Path, keys: str) -> list[str]:
    lines = (shared / "golden" / f"state_dict_{keys}.tsv").read_text().splitlines()
    return [line.split("\t")[0] for line in lines if line and not line.startswith("#")]


def make_tensors(shared: Path, keys: str) -> dict[str, Tensor]:
    return {name.removeprefix("encoder."): torch.zeros(1) for name in list_names(shared, keys)}


def test_tensors_that_are_left_out_are_listed_by_reason(shared: Path, as_lightning: Wrap) -> None:
    content = as_lightning(make_tensors(shared, "pansplat-512"))
    auxiliary = list_names(shared, "pansplat-512-360loc_aux")
    content["state_dict"] |= {name: torch.zeros(1) for name in auxiliary}
    left = {reason: len(names) for reason, names in match_tensors(content, "360loc").items()}
    assert left == {"recomputed grids": 5, "auxiliary heads, for training only": 18, "training state": 5}


def test_missing_and_surplus_tensors_are_named_and_counted(shared: Path, as_lightning: Wrap) -> None:
    content = as_lightning(make_tensors(shared, "pansplat-512"))
    state = content["state_dict"]
    removed = [name for name in state if "q_proj" in name]
    for name in removed:
        del state[name]
    state["encoder.new.weight"] = state["losses.2.gaussian_head.new"] = torch.zeros(1)
    message = (
        rf"odd\.ckpt: .* lacked 12 \({re.escape(min(removed))}.*, \.\.\.\).* unknown 2 \(encoder.new.weight, losses.2"
    )
    expect_error(message, match_tensors, content, "odd.ckpt")


def test_checkpoints_of_other_models_are_refused(as_lightning: Wrap) -> None:
    expect_error(r"1 \(encoder.fc\)", lambda: match_tensors(as_lightning({"fc": torch.zeros(1)}), "x"))
    with pytest.raises(InputError, match="MVSplat baseline"):
        match_tensors(as_lightning({"backbone.backbone.conv1.weight": torch.zeros(1)}), "x")
    expect_error("got tensors none", lambda: match_tensors(as_lightning({}), "x"))


def test_a_changed_grid_is_refused(recipe_weights: dict[str, Tensor], as_lightning: Wrap) -> None:
    name = "mono_depth.c2e.2.sample_grid"
    with pytest.raises(InputError, match=f"the official grid in {name}"):
        convert_tensors(as_lightning(recipe_weights | {name: recipe_weights[name].flip(2)}), "x")
    with pytest.raises(InputError, match=f"the official grid in {name}"):
        convert_tensors(as_lightning(recipe_weights | {name: recipe_weights[name][:, :, :4]}), "x")


def test_values_that_are_not_finite_are_refused(recipe_weights: dict[str, Tensor], as_lightning: Wrap) -> None:
    name = "backbone.decoder.inner1.bias"
    broken = recipe_weights[name].clone()
    broken[3] = torch.nan
    expect_error(f"got NaN or infinity in {name}", convert_tensors, as_lightning(recipe_weights | {name: broken}), "x")


def test_half_precision_weights_become_float32(recipe_weights: dict[str, Tensor], as_lightning: Wrap) -> None:
    name = "gaussian_head.gaussians_mlp_list.0.0.bias"
    tensors = convert_tensors(as_lightning(recipe_weights | {name: recipe_weights[name].half()}), "x")
    assert {tensor.dtype for tensor in tensors.values()} == {torch.float32, torch.int64}
