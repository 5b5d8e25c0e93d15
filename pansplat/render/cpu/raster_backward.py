"""Compositing of tiles on the CPU, backward."""

from pansplat.render.cpu.raster import Floats, Integers, Longs
from pansplat.render.cpu.tables import Plane


def raster_backward(
    records: Floats,
    values: Floats,
    entries: Integers,
    starts: Longs,
    slots: Longs,
    plane: Plane,
    sums: Floats,
    grad_sums: Floats,
    grad_records: Floats,
    grad_values: Floats,
    *,
    first_row: int = 0,
    threads: int = 1,
) -> None:
    """Write each entry's gradient into its slot.

    Args:
        records, values, entries, starts, slots: as in `raster_forward`.
        plane: the picture's pixels.
        sums: what `raster_forward` wrote.
        grad_sums: gradient of the sums, the same shape.
        grad_records: (slot, FIELDS), written at the entries' slots; directions in the columns DIRECTION, zeros in REST.
        grad_values: (slot, channel + 1), written likewise.
        first_row: of tiles, the band's first.
        threads: to work on; the result does not depend on it.
    """
    raise NotImplementedError
