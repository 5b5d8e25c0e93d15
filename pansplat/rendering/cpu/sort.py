"""Stage four: each tile's Gaussians front to back; equal distances in the order of their numbers.

A tile's few thousand are sorted in the first caches: their distances, as integers in the same order, by the two leading
digits, and what is out of order then by insertion. Where that is too much, as when all but one stand close together, a
sort by all the digits takes its place: it takes as long whatever the distances.
"""

import numpy as np

from pansplat.rendering.cpu.bins import TileLists
from pansplat.rendering.cpu.compiling import inlined, kernel
from pansplat.rendering.cpu.memory import Lease
from pansplat.rendering.cpu.observe import PIECE
from pansplat.rendering.cpu.raster import pieces_of
from pansplat.rendering.cpu.simd import element, prefetch, put
from pansplat.rendering.cpu.threads import share

_DIGIT = 11  # bits sorted by at a time, at most: 2048 counters stay in the first cache
_MORE = 3  # bits of a digit beyond half of those that number a tile's entries: few are left out of order
_PATIENCE = 4  # places an entry is moved by insertion, on average, before it is given up
_AHEAD = 32  # entries, between asking for a distance and reading it
_ROUNDING = 12  # lowest bits of a distance: equal ones, found by other steps, may differ in the last few, so cut them
_FLIP = np.int64(0x7FFFFFFFFFFFFFFF)


@kernel
def _measure(piece, records, radii, towards, depths):
    """Write the depths along an axis of a piece's Gaussians."""
    for g in range(piece * PIECE, min((piece + 1) * PIECE, len(radii))):
        x = np.float64(records[g, 0]) + np.float64(records[g, 3])
        y = np.float64(records[g, 1]) + np.float64(records[g, 4])
        z = np.float64(records[g, 2]) + np.float64(records[g, 5])
        depths[g] = radii[g] * (x * towards[0] + y * towards[1] + z * towards[2])


def depths_along(records: np.ndarray, radii: np.ndarray, towards: np.ndarray, lease: Lease, threads: int) -> np.ndarray:
    """How far Gaussians lie along an axis, (n,) float64, metres.

    Args:
        records: of the Gaussians.
        radii: float64, metres.
        towards: the axis in the records' axes.
        lease: for the depths.
        threads: to work on.
    """
    depths = lease.array(len(radii), np.float64)
    share(lambda piece: _measure(piece, records, radii, towards, depths), -(-len(radii) // PIECE), threads)
    return depths


@inlined
def _read_keys(entries, slots, keys, begin, count, words, own_entries, own_slots):
    """Copy a tile's entries and slots, and fetch its distances as integers in the same order; the least and largest."""
    low, high, end = _FLIP, -_FLIP, len(entries) - 1
    for j in range(count):
        prefetch(keys, element(entries, min(begin + j + _AHEAD, end)) & np.int64(0xFFFFFFFF))
        entry = element(entries, begin + j)
        key = element(keys, entry & np.int64(0xFFFFFFFF))
        key = (key if key >= 0 else (key ^ _FLIP) + 1) >> _ROUNDING  # -0.0 is 0.0
        low, high = min(low, key), max(high, key)
        put(words, j, np.uint64(key))
        put(own_entries, j, entry)
    if len(slots) > 0:
        for j in range(count):
            put(own_slots, j, element(slots, begin + j))
    return np.uint64(low), np.uint64(high)


@inlined
def _bit_length(number):
    bits = 0
    while number > 0:
        number >>= np.uint64(1)
        bits += 1
    return bits


@inlined
def _pack(words, count, least, cut, place_bits, low, high, bits, low_counters, high_counters):
    """Put each key's place below it, and count two digits of `bits` bits, from bits `low` and `high` on."""
    for digit in range(1 << bits):
        put(low_counters, digit, np.int32(0))
        put(high_counters, digit, np.int32(0))
    mask = (np.uint64(1) << np.uint64(bits)) - np.uint64(1)
    for j in range(count):
        word = (element(words, j) - least) >> cut << np.uint64(place_bits) | np.uint64(j)
        put(words, j, word)
        first, second = np.int64(word >> np.uint64(low) & mask), np.int64(word >> np.uint64(high) & mask)
        put(low_counters, first, np.int32(element(low_counters, first) + 1))
        put(high_counters, second, np.int32(element(high_counters, second) + 1))


@inlined
def _deal(words, count, shift, bits, counters, dealt):
    """Move words to where a digit puts them, keeping the order of equal ones; the counters are lost."""
    mask, total = (np.uint64(1) << np.uint64(bits)) - np.uint64(1), np.int64(0)
    for digit in range(1 << bits):
        held = element(counters, digit)
        put(counters, digit, np.int32(total))
        total += np.int64(held)
    for j in range(count):
        word = element(words, j)
        digit = np.int64(word >> np.uint64(shift) & mask)
        place = element(counters, digit)
        put(counters, digit, np.int32(place + 1))
        put(dealt, np.int64(place), word)


@inlined
def _insert(words, count):
    """Sort words that are nearly in order; whether they were near enough."""
    moves = np.int64(0)
    for j in range(1, count):
        word, at = element(words, j), j
        while at > 0 and element(words, at - 1) > word:
            put(words, at, element(words, at - 1))
            at -= 1
        put(words, at, word)
        moves += j - at
        if moves > _PATIENCE * count:
            return False
    return True


@inlined
def _sort_by_all_digits(words, spare, count, end, counters):
    """Sort words of `end` bits, however they are spread; the two arrays, sorted first."""
    for shift in range(0, end, _DIGIT):
        counters[:] = 0
        for j in range(count):
            digit = np.int64(element(words, j) >> np.uint64(shift) & np.uint64((1 << _DIGIT) - 1))
            put(counters, digit, np.int32(element(counters, digit) + 1))
        _deal(words, count, shift, _DIGIT, counters, spare)
        words, spare = spare, words
    return words, spare


@kernel
def _sort_tiles(entries, slots, keys, starts, low, high):
    """Sort the entries and slots of some tiles.

    Args:
        entries: flat words of 64 bits.
        keys: the distances' bits, as int64.
    """
    most = 1
    for tile in range(low, high):
        most = max(most, starts[tile + 1] - starts[tile])
    words, dealt, own_entries = np.empty(most, np.uint64), np.empty(most, np.uint64), np.empty(most, np.int64)
    own_slots = np.empty(most if len(slots) > 0 else 0, slots.dtype)
    low_counters, high_counters = np.empty(1 << _DIGIT, np.int32), np.empty(1 << _DIGIT, np.int32)
    for tile in range(low, high):
        begin, count = starts[tile], starts[tile + 1] - starts[tile]
        if count < 2:
            continue
        least, largest = _read_keys(entries, slots, keys, begin, count, words, own_entries, own_slots)
        key_bits, place_bits = _bit_length(largest - least), _bit_length(np.uint64(count - 1))
        cut = max(0, key_bits + place_bits - 64)
        end = key_bits - cut + place_bits
        bits = min(place_bits // 2 + _MORE, _DIGIT, end // 2)
        upper, lower = end - bits, end - 2 * bits
        _pack(words, count, least, np.uint64(cut), place_bits, lower, upper, bits, low_counters, high_counters)
        _deal(words, count, lower, bits, low_counters, dealt)
        _deal(dealt, count, upper, bits, high_counters, words)
        if not _insert(words, count):
            words, dealt = _sort_by_all_digits(words, dealt, count, end, low_counters)
        mask = (np.uint64(1) << np.uint64(place_bits)) - np.uint64(1)
        for j in range(count):
            place = np.int64(element(words, j) & mask)
            put(entries, begin + j, element(own_entries, place))
            if len(slots) > 0:
                put(slots, begin + j, element(own_slots, place))


def sort_front_to_back(lists: TileLists, distances: np.ndarray, threads: int) -> None:
    """Sort each tile's entries, with their slots, nearest first.

    Args:
        lists: of tiles, in the order of the Gaussians' numbers; sorted in place.
        distances: of the Gaussians, float64, cut to a part in 2^40; to a little less in a tile of such a range that
            keys and places together exceed 64 bits.
        threads: to work on; the order does not depend on it.
    """
    pieces = pieces_of(lists.starts, threads)
    entries, keys = lists.entries.reshape(-1).view(np.int64), distances.view(np.int64)

    def work(piece: int) -> None:
        _sort_tiles(entries, lists.slots, keys, lists.starts, pieces[piece], pieces[piece + 1])

    share(work, len(pieces) - 1, threads)
