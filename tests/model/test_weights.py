"""The table of names is complete both ways, and whatever does not fit it is refused by name."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.model.mvsplat import MVSplat
from pansplat.model.pansplat import PanSplat
from pansplat.model.weights import ModelName, convert_tensors, match_tensors, official_names, require_shapes

Wrap = Callable[[dict[str, Tensor]], dict[str, object]]
CASES: list[tuple[ModelName, int, int]] = [("pansplat", 993, 5), ("mvsplat", 471, 0)]


def listed(shared: Path, keys: str) -> list[str]:
    lines = (shared / "golden" / f"state_dict_{keys}.tsv").read_text().splitlines()
    return [line.split("\t")[0] for line in lines if line and not line.startswith("#")]


def empty(shared: Path, keys: str) -> dict[str, Tensor]:
    return {name.removeprefix("encoder."): torch.zeros(1) for name in listed(shared, keys)}


@pytest.mark.parametrize(("model", "count", "derived"), CASES)
def test_every_original_tensor_is_used_or_computed(model: ModelName, count: int, derived: int, shared: Path) -> None:
    theirs = {name.removeprefix("encoder.") for name in listed(shared, f"{model}-512")}
    table = official_names(model)
    assert len(theirs) == count and table.keys() <= theirs
    assert len(theirs - table.keys()) == derived
    assert all(name.endswith("sample_grid") for name in theirs - table.keys())


@pytest.mark.parametrize("model", ["pansplat", "mvsplat"])
def test_every_tensor_of_ours_has_one_original(model: ModelName) -> None:
    with torch.device("meta"):
        network = PanSplat() if model == "pansplat" else MVSplat()
    names = list(official_names(model).values())
    assert len(set(names)) == len(names)
    assert set(names) == network.state_dict().keys()


def test_converted_tensors_fit_the_network(recipe_weights: dict[str, Tensor], as_lightning: Wrap) -> None:
    tensors = convert_tensors(as_lightning(recipe_weights), "recipe")
    with torch.device("meta"):
        require_shapes(tensors, PanSplat().state_dict(), "recipe")
    assert torch.equal(
        tensors["heads.levels.3.linear.weight"], recipe_weights["gaussian_head.gaussians_mlp_list.3.0.weight"]
    )
    assert torch.equal(
        tensors["cost_volume.levels.1.refine.unet.encoder.2.attention.project_in.weight"],
        recipe_weights["depth_predictor.corr_refine_nets.2.3.input_blocks.5.1.qkv.weight"][..., 0],
    )


def test_a_checkpoint_with_auxiliary_heads_is_told_what_is_left_out(shared: Path, as_lightning: Wrap) -> None:
    content = as_lightning(empty(shared, "pansplat-512"))
    auxiliary = listed(shared, "pansplat-512-360loc_aux")
    content["state_dict"] |= {name: torch.zeros(1) for name in auxiliary}
    report = match_tensors(content, "360loc")
    assert len(report.used) == 988 and not report.missing and not report.surplus
    left = {reason: len(names) for reason, names in report.unused.items()}
    assert left == {"computed anew": 5, "auxiliary heads, for training only": 18, "state of the training": 5}
    report.require_complete("360loc")


def test_missing_and_surplus_tensors_are_named_and_counted(shared: Path, as_lightning: Wrap) -> None:
    content = as_lightning(empty(shared, "pansplat-512"))
    state = content["state_dict"]
    gone = [name for name in state if "q_proj" in name]
    for name in gone:
        del state[name]
    state["encoder.new.weight"] = state["losses.2.gaussian_head.new"] = torch.zeros(1)
    report = match_tensors(content, "odd.ckpt")
    assert sorted(report.missing) == sorted(gone)
    with pytest.raises(InputError) as caught:
        report.require_complete("odd.ckpt")
    message = str(caught.value)
    assert message.startswith("odd.ckpt: needed exactly the tensors of the original pansplat, lacked 12 (")
    assert gone[0] in message and ", ...)" in message
    assert "found unknown 2 (encoder.new.weight, losses.2.gaussian_head.new)" in message


def test_a_missing_grid_is_missing(shared: Path, as_lightning: Wrap) -> None:
    weights = empty(shared, "pansplat-512")
    del weights["mono_depth.c2e.3.sample_grid"]
    assert match_tensors(as_lightning(weights), "x").missing == ["encoder.mono_depth.c2e.3.sample_grid"]


def test_checkpoints_of_other_models_are_refused(as_lightning: Wrap) -> None:
    with pytest.raises(InputError, match=r"original PanSplat or its MVSplat baseline, got tensors 1 \(encoder.fc\)"):
        match_tensors(as_lightning({"fc": torch.zeros(1)}), "x")
    with pytest.raises(InputError, match="got tensors none"):
        match_tensors(as_lightning({}), "x")


def test_another_grid_is_refused(recipe_weights: dict[str, Tensor], as_lightning: Wrap) -> None:
    name = "mono_depth.c2e.2.sample_grid"
    with pytest.raises(InputError, match=f"the original's grid in {name}"):
        convert_tensors(as_lightning(recipe_weights | {name: recipe_weights[name].flip(2)}), "x")
    with pytest.raises(InputError, match=f"the original's grid in {name}"):
        convert_tensors(as_lightning(recipe_weights | {name: recipe_weights[name][:, :, :4]}), "x")


def test_numbers_that_are_not_finite_are_refused(mvsplat_weights: dict[str, Tensor], as_lightning: Wrap) -> None:
    name = "backbone.backbone.conv2.bias"
    spoilt = mvsplat_weights[name].clone()
    spoilt[3] = torch.nan
    with pytest.raises(InputError, match=f"got NaN or infinity in {name}"):
        convert_tensors(as_lightning(mvsplat_weights | {name: spoilt}), "x")


def test_half_precision_weights_become_float32(mvsplat_weights: dict[str, Tensor], as_lightning: Wrap) -> None:
    tensors = convert_tensors(as_lightning({name: tensor.half() for name, tensor in mvsplat_weights.items()}), "x")
    assert {tensor.dtype for tensor in tensors.values()} == {torch.float32}


def test_wrong_shapes_are_named() -> None:
    needed = {"a": torch.zeros(2, 3), "b": torch.zeros(1)}
    with pytest.raises(InputError, match=r"got 1 \(a \(3, 2\) instead of \(2, 3\)\)"):
        require_shapes({"a": torch.zeros(3, 2), "b": torch.zeros(1)}, needed, "x")
    with pytest.raises(InputError, match=r"lacked 1 \(b\); found unknown 1 \(c\)"):
        require_shapes({"a": torch.zeros(2, 3), "c": torch.zeros(1)}, needed, "x")
    require_shapes(needed, needed, "x")
