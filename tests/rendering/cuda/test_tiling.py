"""Tile intersections against a brute-force search, and the tables that the kernels read."""

import pytest
import torch

from pansplat.rendering.cuda.rasterize import RecordLayout, pack_records, unpack_gradients
from pansplat.rendering.cuda.tiling import TILE_SIZE, intersect_tiles, sort_instances, tile_pixels
from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.projection import Footprints
from pansplat.rendering.reference import tile_ranges

pytestmark = pytest.mark.exhaustive


def _boxes(count: int, size: tuple[int, int], seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    centre = torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor((1.4 * width, 1.4 * height))
    reach = 30 * torch.rand(count, 2, generator=generator, dtype=torch.float64) ** 3
    low, high = centre - reach - 5, centre + reach - 5
    boxes = torch.stack((low[:, 0], high[:, 0], low[:, 1], high[:, 1]), dim=1)
    boxes[::7] = torch.tensor((1.0, -1.0, 1.0, -1.0), dtype=torch.float64)
    return boxes


@pytest.mark.parametrize("wraps", [True, False])
@pytest.mark.parametrize("limit", [1, 30, 1 << 20])
def test_tile_intersections_equal_brute_force_in_bands_of_any_size(wraps, limit, triton_device):
    size, num = (50, 70), 3
    boxes = [_boxes(40, size, seed) for seed in range(num)]
    keys = [torch.randint(0, 9, (40,), generator=torch.Generator().manual_seed(seed)).double() for seed in range(num)]
    bases = [0, 40, 80]
    on_device = [[table.to(triton_device) for table in tables] for tables in (boxes, keys)]
    instances = sort_instances(*on_device, bases, size, wraps=wraps)
    rows, columns = instances.grid
    assert (rows, columns) == (4 * num, 5)
    expected = [[] for _ in range(rows * columns)]
    for plane in range(num):
        ranges = tile_ranges(boxes[plane], size, wraps, TILE_SIZE).tolist()
        for i in sorted(range(40), key=lambda i: (float(keys[plane][i]), i)):
            left, across, top, down = ranges[i]
            for tile in ((y, (left + x) % columns) for y in range(top, top + down) for x in range(across)):
                expected[(plane * 4 + tile[0]) * columns + tile[1]].append(bases[plane] + i)
    found, bands = [], 0
    for band in intersect_tiles(instances, limit):
        assert band.rows[0] * columns == len(found)
        bands += 1
        found += [band.record_ids[a:b].tolist() for a, b in zip(band.starts[:-1], band.starts[1:], strict=True)]
    assert found == expected and sum(map(len, expected)) > 100
    assert bands == {1: 4 * num, 1 << 20: 1}.get(limit, bands)


def test_slots_are_the_positions_before_the_sort_by_tile(triton_device):
    size = (50, 70)
    box, key = _boxes(40, size, 0), torch.rand(40, generator=torch.Generator().manual_seed(1))
    box, key = box.to(triton_device), key.to(triton_device)
    instances = sort_instances([box], [key], [0], size, wraps=False)
    (band,) = intersect_tiles(instances)
    together = torch.empty_like(band.record_ids)
    together[band.slots.long()] = band.record_ids
    counts = band.ends.diff(prepend=band.ends.new_zeros(1))
    assert torch.equal(together, instances.records.repeat_interleave(counts))
    assert int(counts.max()) > 4 and band.ends.dtype == torch.int64


def test_tiles_are_split_into_bands_of_16_bit_indices(monkeypatch, triton_device):
    from pansplat.rendering.cuda import tiling

    monkeypatch.setattr(tiling, "_MAX_TILES", 10)
    size = (50, 70)
    box, key = _boxes(40, size, 0).to(triton_device), torch.arange(40.0, device=triton_device)
    instances = sort_instances([box], [key], [0], size, wraps=False)
    found = [band.rows for band in intersect_tiles(instances)]
    assert found == [(0, 2), (2, 4)]


def test_centres_and_offsets_together_are_more_accurate_than_their_type():
    for layout, exact in (("equirect", True), ("cubemap", True), ("pinhole", False)):
        planes = image_planes(layout, (200, 360), vertical_fov_degrees=90.0, face_size=100, device=torch.device("cpu"))
        pixels = tile_pixels(planes, exact=exact, dtype=torch.float32)
        height, width = planes[0].size
        rows, columns = -(-height // TILE_SIZE), -(-width // TILE_SIZE)
        both = pixels.centres.double().sum(dim=1)[:, :, None] + pixels.offsets.double()
        both = both.reshape(len(planes), rows, columns, -1, TILE_SIZE, TILE_SIZE).permute(0, 1, 4, 2, 5, 3)
        both = both.reshape(len(planes), rows * TILE_SIZE, columns * TILE_SIZE, -1)[:, :height, :width]
        points = torch.stack([plane.directions() if exact else plane.coordinates() for plane in planes])
        # Only the offsets are rounded.
        assert float((both - points).abs().max()) < 2**-24 * float(pixels.offsets.abs().max())


@pytest.mark.parametrize("exact", [True, False])
def test_records_and_gradient_records_have_the_columns_of_their_layout(exact):
    layout = RecordLayout(exact, channels=5)
    footprints = Footprints(*(torch.rand(3, *shape) for shape in ((3,), (3, 3), (), (), (6,))))
    footprints = footprints._replace(point=torch.rand(3, 3, dtype=torch.float64))
    records = pack_records(footprints, layout)
    point, residual = records[:, : 2 * layout.axes].double().split(layout.axes, dim=1)
    assert float((point + residual - footprints.point[:, : layout.axes]).abs().max()) < 1e-14
    assert records.shape == (3, layout.record_size)
    assert torch.equal(records[:, layout.peak_column], footprints.peak)
    assert torch.equal(records[:, layout.peak_column + 1 :], footprints.values)
    rows = torch.arange(3.0 * layout.gradient_size).reshape(3, -1)
    back = unpack_gradients(rows, footprints.rows, layout)
    assert torch.equal(back.peak, rows[:, -7]) and torch.equal(back.values, rows[:, -6:])
    assert torch.equal(back.radial_variance, rows[:, -8] if exact else torch.zeros(3))
    assert back.point.dtype == torch.float64 and back.rows.shape == (3, 3, 3)
