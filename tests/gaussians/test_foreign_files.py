"""Files as other programs write them are read right side up: headers and layouts are theirs, byte by byte.

Source: save_ply of the training code of 3D Gaussian Splatting (graphdeco-inria/gaussian-splatting, gaussian_model.py)
with the header of plyfile; serializePly and serializePlyCompressed of SuperSplat (playcanvas/supersplat,
src/splat-serialize.ts). The programs keep y down in these files.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float, UInt8

from pansplat import pipeline
from pansplat.gaussians.formats import load_scene
from pansplat.gaussians.scene import Gaussians

COUNT = 600  # three chunks of a compressed .ply, the last of which is not full
SH_0 = 0.28209479177387814


def make_room(seed: int = 0) -> Gaussians:
    """A sphere of 2 m around the origin: blue above (y < 0), red below; harmonics of degree 3."""
    random = np.random.default_rng(seed)
    directions = random.normal(size=(COUNT, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    harmonics = 0.1 * random.normal(size=(COUNT, 16, 3))
    below = directions[:, 1] > 0
    harmonics[:, 0] = np.where(below[:, None], (1.6, -1.6, -1.6), (-1.6, -1.6, 1.6))
    quats = random.normal(size=(COUNT, 4))
    return Gaussians(
        means=torch.tensor(2 * directions, dtype=torch.float32),
        scales=torch.tensor(random.uniform(0.1, 0.4, (COUNT, 3)), dtype=torch.float32),
        quats=torch.tensor(quats / np.linalg.norm(quats, axis=1, keepdims=True), dtype=torch.float32),
        opacities=torch.tensor(random.uniform(0.5, 0.95, COUNT), dtype=torch.float32),
        harmonics=torch.tensor(harmonics, dtype=torch.float32),
        levels=torch.zeros(COUNT, dtype=torch.int64),
        views=torch.zeros(COUNT, dtype=torch.int64),
    )


def list_columns(gaussians: Gaussians) -> dict[str, Float[np.ndarray, "n"]]:
    """The properties of a 3DGS file in the order of the training code; `f_rest` is ordered by channel."""
    rest = gaussians.harmonics[:, 1:].transpose(1, 2).flatten(1).numpy()
    columns = {name: gaussians.means[:, axis].numpy() for axis, name in enumerate("xyz")}
    columns |= {f"n{name}": np.zeros(len(rest), np.float32) for name in "xyz"}
    columns |= {f"f_dc_{k}": gaussians.harmonics[:, 0, k].numpy() for k in range(3)}
    columns |= {f"f_rest_{k}": rest[:, k] for k in range(rest.shape[1])}
    columns["opacity"] = torch.logit(gaussians.opacities).numpy()
    columns |= {f"scale_{k}": gaussians.scales[:, k].log().numpy() for k in range(3)}
    return columns | {f"rot_{k}": 1.7 * gaussians.quats[:, k].numpy() for k in range(4)}  # not normalised


def write_ply(path: Path, columns: dict[str, Float[np.ndarray, "n"]]) -> None:
    """As plyfile and SuperSplat write it."""
    count = len(next(iter(columns.values())))
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in columns]
    table = np.stack(list(columns.values()), axis=1).astype("<f4")
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + table.tobytes())


def write_stock(path: Path, gaussians: Gaussians) -> None:
    """The output of the training code: point_cloud.ply."""
    write_ply(path, list_columns(gaussians))


def write_supersplat(path: Path, gaussians: Gaussians) -> None:
    """A .ply of SuperSplat: the properties of its input, here of one without normals, in another order."""
    columns = {name: values for name, values in list_columns(gaussians).items() if not name.startswith("n")}
    order = sorted(columns, key=lambda name: (name.startswith("f_rest"), not name.startswith(("x", "y", "z"))))
    write_ply(path, {name: columns[name] for name in order})


def write_supersplat_compressed(path: Path, gaussians: Gaussians) -> None:
    """A .compressed.ply of SuperSplat 2: blocks of 256 Gaussians with ranges, and harmonics in bytes."""
    columns = list_columns(gaussians)
    names = ("x", "y", "z", "scale_0", "scale_1", "scale_2", "f_dc_0", "f_dc_1", "f_dc_2")
    data = np.stack([columns[name] for name in names], axis=1)
    data[:, 6:] = data[:, 6:] * SH_0 + 0.5
    quats = gaussians.quats.numpy()
    ranges, packed = [], []
    for first in range(0, COUNT, 256):
        part, turn = data[first : first + 256], quats[first : first + 256]
        low, high = part.min(axis=0), part.max(axis=0)
        ranges.append(np.concatenate([low[:3], high[:3], low[3:6], high[3:6], low[6:], high[6:]]))
        unit = np.where(high - low < 1e-5, 0, (part - low) / np.maximum(high - low, 1e-5))
        color = np.concatenate([unit[:, 6:], gaussians.opacities.numpy()[first : first + 256, None]], axis=1)
        packed.append(
            np.stack(
                [
                    pack(unit[:, :3], (11, 10, 11)),
                    pack_quats(turn),
                    pack(unit[:, 3:6], (11, 10, 11)),
                    pack(color, (8, 8, 8, 8)),
                ],
                axis=1,
            )
        )
    rest = np.stack([columns[f"f_rest_{k}"] for k in range(45)], axis=1)
    borders = ("min_", "max_", "min_scale_", "max_scale_")
    chunk = [f"property float {border}{axis}" for border in borders for axis in "xyz"]
    chunk += [f"property float {end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    lines = ["ply", "format binary_little_endian 1.0", "comment Generated by SuperSplat 2.7.0"]
    lines += [f"element chunk {len(ranges)}", *chunk, f"element vertex {COUNT}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    lines += [f"element sh {COUNT}", *(f"property uchar f_rest_{k}" for k in range(45)), "end_header", ""]
    stored: UInt8[np.ndarray, "n 45"] = np.clip(np.trunc((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    body = np.concatenate(ranges).astype("<f4").tobytes() + np.concatenate(packed).astype("<u4").tobytes()
    path.write_bytes("\n".join(lines).encode() + body + stored.tobytes())


def pack(values: Float[np.ndarray, "n k"], bits: tuple[int, ...]) -> np.ndarray:
    """Values in [0, 1] in one word each row, the first one in the upper bits."""
    words = np.zeros(len(values), np.uint64)
    for column, count in zip(values.T, bits, strict=True):
        steps = (1 << count) - 1
        words = words << np.uint64(count) | np.clip(np.floor(column * steps + 0.5), 0, steps).astype(np.uint64)
    return words


def pack_quats(quats: Float[np.ndarray, "n 4"]) -> np.ndarray:
    """Index of the largest component in two bits, and the others times sqrt(1/2) in ten bits each."""
    words = []
    for quat in quats:
        largest = int(np.abs(quat).argmax())
        signed = quat * (-1 if quat[largest] < 0 else 1)
        others = np.delete(signed, largest)[None] * np.sqrt(0.5) + 0.5
        words.append(np.uint64(largest << 30) | pack(others, (10, 10, 10))[0])
    return np.array(words)


WRITERS = {
    "point_cloud.ply": (write_stock, 1e-5, 1e-5, 1e-5),
    "supersplat.ply": (write_supersplat, 1e-5, 1e-5, 1e-5),
    "supersplat.compressed.ply": (write_supersplat_compressed, 4e-3, 4e-3, 0.036),
}


@pytest.mark.parametrize("name", WRITERS)
def test_files_of_other_programs_have_their_values_and_are_upright(tmp_path: Path, name: str) -> None:
    write, position, rotation, color = WRITERS[name]
    room = make_room()
    write(tmp_path / name, room)
    scene = load_scene(tmp_path / name)
    found = scene.gaussians
    index = torch.cdist(found.means, room.means, compute_mode="donot_use_mm_for_euclid_dist").argmin(dim=1)
    assert len(index.unique()) == COUNT and found.degree == 3 and len(scene.cam2world) == 0
    room = room.select(index)
    assert float((found.means - room.means).abs().max()) <= position
    cosines = (torch.nn.functional.normalize(found.quats, dim=1) * room.quats).sum(dim=1).abs()
    assert float(1 - cosines.min()) <= rotation
    assert float((found.harmonics - room.harmonics).abs().max()) <= color
    with torch.no_grad():
        image = pipeline.render(scene, torch.eye(4, dtype=torch.float64), size=(32, 64)).color
    above, below = image[:, :12].mean(dim=(1, 2)), image[:, -12:].mean(dim=(1, 2))
    assert above[2] > 2 * above[0] and below[0] > 2 * below[2], "blue is above, red is below"
