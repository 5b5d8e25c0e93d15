"""What the tiles of the CPU rasteriser read: one record and one row of values a Gaussian, one entry a tile.

Source: docs/rendering.md, section 3, in powers of two. With the vectors and numbers of a record, and
k a unit direction near the pixel's d:

    A = a.(d - n),  B = b.(d - n),  L = 1 + l.(d - n),  l = n + front_a a + front_b b
    alpha = min(0.99, 2^(level - Q / (L^2 + along Q))),  Q = A^2 + B^2

so a and b are the page's times sqrt(UNIT), `along` is its S' over UNIT, and `level` is log2 of the peak. n is kept
as a float32 and what that leaves, so that n - k has no cancellation. For the classic kernel n is the point in pixels
(z = 0), d the pixel's centre, a_y = a_z = b_z = 0, along = front_a = front_b = 0, and L is 1.

Only A / L and B / L count, and a.n = b.n = 0. Gradients of records are those with each ray as long as makes L = 1.

Arrays, all C-contiguous numpy:

    records   float32 (n, FIELDS)       best aligned to 64 bytes: one cache line a Gaussian
    values    float32 (n, channel + 1)  colours, then the radius in metres
    entries   int32   (e, 2)            index of the Gaussian, and its box within the tile (see `BOX_BITS`)
    starts    int64   (tile + 1)        where each tile's entries begin, front to back; tiles row by row
    slots     int32   (e)               for the backward: the row of gradients that the entry writes; int64 if it must
"""

import math

TILE = 32
"""Side of a tile, pixels."""

FIELDS = 16
"""Numbers a record."""

DIRECTION = 0  # n rounded to float32: x, y, z
REST = 3  # n minus that: x, y, z
FIRST = 6  # a: x, y, z
SECOND = 9  # b: x, y, z
FRONT_A = 12
FRONT_B = 13
ALONG = 14
LEVEL = 15

UNIT = 0.5 * math.log2(math.e)
"""exp(-q / 2) = 2^(-UNIT q)."""

BOX_BITS = 8
"""An entry's box is x0 + (x1 << 8) + (y0 << 16) + (y1 << 24): its first and last pixel column and row counted from
the tile's own corner, 0 to 31, both ends included. It may be larger than needed: what lies outside the ellipse has
an alpha below the cut. A box that wraps into both ends of one tile takes the tile's full width."""
