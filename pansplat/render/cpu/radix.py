"""Stage two: the Gaussians of one picture, front to back; equal distances in the order of their numbers.

A least-significant-digit radix sort of 64-bit words. A word holds the distance, as the bits of a float64 cut to 29
bits of mantissa and counted from the nearest one's, above the Gaussian's number. So distances are told apart 64 times
finer than in float32, in three passes for most scenes. Every pass keeps the order of equal digits however many threads
share it.
"""

from collections.abc import Callable

import numpy as np

from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.memory import Lease
from pansplat.render.cpu.observe import PIECE
from pansplat.render.cpu.simd import element, put
from pansplat.render.cpu.threads import share

_DIGIT = 11  # bits sorted by at a time: 2048 counters stay in the first cache
_CUT = 23  # bits of a float64's mantissa left out
_LANES = 64
_FLIP = np.int64(0x7FFFFFFFFFFFFFFF)


@inlined
def _fill_keys(start, stop, records, radii, towards, floats, bits):
    """Write the distances, or depths, of some Gaussians as integers in the same order."""
    by_depth = (towards[0] != 0) | (towards[1] != 0) | (towards[2] != 0)
    for i in range(stop - start):
        floats[i] = radii[start + i]
    if by_depth:
        for i in range(stop - start):
            g = start + i
            x = np.float64(records[g, 0]) + np.float64(records[g, 3])
            y = np.float64(records[g, 1]) + np.float64(records[g, 4])
            z = np.float64(records[g, 2]) + np.float64(records[g, 5])
            floats[i] *= x * towards[0] + y * towards[1] + z * towards[2]
        for i in range(stop - start):
            bits[i] = bits[i] if bits[i] >= 0 else bits[i] ^ _FLIP


@kernel
def _survey(piece, records, radii, boxes, towards, survey):
    """Count a piece's Gaussians with a box, and find their least and largest key."""
    floats = np.empty(_LANES)
    bits = floats.view(np.int64)
    count, low, high = 0, _FLIP, -_FLIP
    for start in range(piece * PIECE, min((piece + 1) * PIECE, len(radii)), _LANES):
        stop = min(start + _LANES, len(radii))
        _fill_keys(start, stop, records, radii, towards, floats, bits)
        for i in range(stop - start):
            if boxes[start + i, 3] >= boxes[start + i, 2]:
                count += 1
                low, high = min(low, bits[i]), max(high, bits[i])
    survey[piece, 0], survey[piece, 1], survey[piece, 2] = count, low, high


@kernel
def _write_words(piece, records, radii, boxes, towards, low, cut, index_bits, starts, words):
    """Write the words of a piece's Gaussians with a box."""
    floats = np.empty(_LANES)
    bits = floats.view(np.int64)
    at = starts[piece]
    for start in range(piece * PIECE, min((piece + 1) * PIECE, len(radii)), _LANES):
        stop = min(start + _LANES, len(radii))
        _fill_keys(start, stop, records, radii, towards, floats, bits)
        for i in range(stop - start):
            if boxes[start + i, 3] >= boxes[start + i, 2]:
                key = (np.uint64(bits[i]) - np.uint64(low)) >> np.uint64(cut)
                words[at] = (key << np.uint64(index_bits)) | np.uint64(start + i)
                at += 1


@inlined
def _digit(word, shift):
    """The digit of a word that begins at bit `shift`."""
    return np.int64(word >> np.uint64(shift) & np.uint64(2**_DIGIT - 1))


@kernel
def _count_digits(part, ends, words, shift, counts):
    """Count the digits of one part of the words."""
    row = counts[part]
    row[:] = 0
    for j in range(ends[part], ends[part + 1]):
        digit = _digit(element(words, j), shift)
        put(row, digit, element(row, digit) + 1)


@kernel
def _places(counts):
    """Turn counts into where each part's words with each digit begin."""
    total = 0
    for digit in range(counts.shape[1]):
        for part in range(counts.shape[0]):
            count = counts[part, digit]
            counts[part, digit] = total
            total += count


@kernel
def _move(part, ends, words, shift, places, sorted_words):
    """Move one part's words to their places."""
    row = places[part]
    for j in range(ends[part], ends[part + 1]):
        word = element(words, j)
        digit = _digit(word, shift)
        place = element(row, digit)
        put(sorted_words, place, word)
        put(row, digit, place + 1)


@kernel
def _move_numbers(part, ends, words, shift, index_bits, places, order):
    """The last pass: only the Gaussians' numbers are kept."""
    row = places[part]
    mask = (np.uint64(1) << np.uint64(index_bits)) - np.uint64(1)
    for j in range(ends[part], ends[part + 1]):
        word = element(words, j)
        digit = _digit(word, shift)
        place = element(row, digit)
        put(order, place, np.int32(word & mask))
        put(row, digit, place + 1)


def front_to_back(
    records: np.ndarray, radii: np.ndarray, boxes: np.ndarray, towards: np.ndarray, lease: Lease, threads: int
) -> np.ndarray:
    """The numbers (int32) of the Gaussians that have a box, nearest first.

    Args:
        records, boxes: of one picture.
        radii: float64, metres.
        towards: the picture's z axis in the records' axes to sort by depth; zeros to sort by distance.
        lease: for the numbers.
        threads: to work on.
    """
    pieces = -(-len(radii) // PIECE)
    survey = np.empty((pieces, 3), np.int64)
    share(lambda piece: _survey(piece, records, radii, boxes, towards, survey), pieces, threads)
    count = int(survey[:, 0].sum())
    if count == 0:
        return np.empty(0, np.int32)
    low = int(survey[:, 1].min())
    index_bits = max(1, (len(radii) - 1).bit_length())
    key_bits = (int(survey[:, 2].max()) - low).bit_length()
    cut = max(_CUT, key_bits + index_bits - 64)
    own = Lease()
    words, spare = own.array(count, np.uint64), own.array(count, np.uint64)
    order = lease.array(count, np.int32)
    starts = np.cumsum(survey[:, 0]) - survey[:, 0]
    share(
        lambda piece: _write_words(piece, records, radii, boxes, towards, low, cut, index_bits, starts, words),
        pieces,
        threads,
    )
    _sort(words, spare, order, index_bits, max(1, key_bits - cut), threads)
    return order


def _sort(
    words: np.ndarray, spare: np.ndarray, order: np.ndarray, index_bits: int, key_bits: int, threads: int
) -> None:
    """Write the low bits of the words, sorted by the high ones; the words are lost."""
    parts = threads if len(words) > PIECE else 1
    ends = np.linspace(0, len(words), parts + 1).astype(np.int64)
    counts = np.empty((parts, 2**_DIGIT), np.int64)
    passes = -(-key_bits // _DIGIT)
    for step in range(passes):
        shift = index_bits + step * _DIGIT
        share(_bound(_count_digits, ends, words, shift, counts), parts, threads)
        _places(counts)
        if step == passes - 1:
            share(_bound(_move_numbers, ends, words, shift, index_bits, counts, order), parts, threads)
        else:
            share(_bound(_move, ends, words, shift, counts, spare), parts, threads)
        words, spare = spare, words


def _bound(work: Callable[..., None], *arguments: object) -> Callable[[int], None]:
    """A kernel with all its arguments but the first."""
    return lambda part: work(part, *arguments)
