"""The gather of a continuous convolution in Numba: features of the neighbours, summed on the functions of the kernel.

For the queries of one block, A[q − begin, b, :] = Σ_pairs coefficient · features of the source. A pair adds to eight
rows of A, a vector of features at a time. The vectors are written in LLVM's terms: Numba does not find them, as it
cannot know that rows do not overlap.
"""

from pathlib import Path

import numpy as np
from llvmlite import ir
from numba import types, uint32, uint64

from gran_bench.neighbors import kernel as neighbors_kernel
from gran_bench.neighbors.kernel import INT64, Argument, Emitter, cached, emitted

_INT32 = ir.IntType(32)
_CORNERS = 8  # functions of a basis that a pair uses

_ROOMS = Path(__file__).parent, Path(neighbors_kernel.__file__).parent
_jitted = cached(*_ROOMS, nogil=True, fastmath={"contract", "nsz"})


class _Corners(Emitter):
    """Emits loads and stores of vectors in an array's own precision."""

    def vector(self, array: Argument, index: ir.Value, lanes: int) -> ir.Value:
        """Address of ``lanes`` neighbours from element ``index`` on."""
        pointer = self.address(array, index)
        return self.builder.bitcast(pointer, ir.VectorType(pointer.type.pointee, lanes).as_pointer())

    def take(self, pointer: ir.Value) -> ir.Value:
        """The vector at an address, which need not be a multiple of its size."""
        value = self.builder.load(pointer)
        value.align = pointer.type.pointee.element.get_abi_size(self.context.target_data)
        return value

    def put(self, value: ir.Value, pointer: ir.Value) -> None:
        """A vector to such an address."""
        store = self.builder.store(value, pointer)
        store.align = pointer.type.pointee.element.get_abi_size(self.context.target_data)

    def everywhere(self, value: ir.Value, lanes: int) -> ir.Value:
        """A number in all lanes."""
        nothing = ir.Constant(ir.VectorType(value.type, lanes), ir.Undefined)
        one = self.builder.insert_element(nothing, value, ir.Constant(_INT32, 0))
        return self.builder.shuffle_vector(one, nothing, ir.Constant(ir.VectorType(_INT32, lanes), [0] * lanes))


def _adder(lanes: int):
    """An intrinsic that adds one pair's share, of ``lanes`` features from ``at`` on, to its eight rows.

    Corners c and c + 4 lie on two layers of the lattice (or two hats) and are loaded before either is stored: at 64
    channels and 4³ nodes they are 4096 bytes apart, and a processor that compares the low address bits would make the
    second wait for the first.
    """

    def add(e, rows, base, channels, at, feature, coefficient, offsets):
        builder, start, plus = e.builder, e.cast(at), {"flags": ("contract", "nsz")}
        features = e.take(e.vector(feature, start, lanes))
        for near in range(_CORNERS // 2):
            sums = []
            for corner in (near, near + _CORNERS // 2):
                place = ir.Constant(INT64, corner)
                offset = builder.zext(builder.load(e.address(offsets, place)), INT64)
                row = builder.mul(builder.add(e.cast(base), offset), e.cast(channels))
                pointer = e.vector(rows, builder.add(row, start), lanes)
                share = e.everywhere(builder.load(e.address(coefficient, place)), lanes)
                sums.append((builder.fadd(e.take(pointer), builder.fmul(share, features, **plus), **plus), pointer))
            for value, pointer in sums:
                e.put(value, pointer)

    return emitted(types.void, _Corners)(add)


_add_64, _add_16, _add_4, _add_1 = (_adder(lanes) for lanes in (64, 16, 4, 1))


@_jitted
def _sum_pairs(begin, end, source, first, coefficient, offsets, features, rows):
    """Pairs ``begin`` … ``end`` into the rows of one query, flat; unsigned indices spare the wrap-around."""
    rows[:] = 0.0
    channels = uint64(features.shape[1])
    wide, middle, small = channels & ~uint64(63), channels & ~uint64(15), channels & ~uint64(3)
    for p in range(uint64(begin), uint64(end)):
        feature, shares, base = features[uint64(source[p])], coefficient[p], uint64(first[p])
        for at in range(uint64(0), wide, uint64(64)):
            _add_64(rows, base, channels, at, feature, shares, offsets)
        for at in range(wide, middle, uint64(16)):
            _add_16(rows, base, channels, at, feature, shares, offsets)
        for at in range(middle, small, uint64(4)):
            _add_4(rows, base, channels, at, feature, shares, offsets)
        for at in range(small, channels):
            _add_1(rows, base, channels, at, feature, shares, offsets)


@_jitted
def gather(begin, end, row_start, source, first, coefficient, offsets, features, gathered):
    """``(rows, B · C)`` of queries ``begin`` … ``end`` in the precision of the features."""
    for q in range(begin, end):
        low, high = row_start[q], row_start[q + 1]
        _sum_pairs(low, high, source, first, coefficient, offsets, features, gathered[q - begin])


@_jitted
def gather_rounded(begin, end, row_start, source, first, coefficient, offsets, features, gathered):
    """The same, summed in float32 and then rounded to the nearest bfloat16, given as its 16 bits; NaN stays NaN."""
    row = np.empty(gathered.shape[1], np.float32)
    bits = row.view(np.uint32)
    for q in range(begin, end):
        low, high = row_start[q], row_start[q + 1]
        _sum_pairs(low, high, source, first, coefficient, offsets, features, row)
        rounded = gathered[q - begin]
        for k in range(len(bits)):
            exact = bits[uint64(k)]
            even = (exact + uint32(0x7FFF) + ((exact >> uint32(16)) & uint32(1))) >> uint32(16)
            is_number = (exact & uint32(0x7FFFFFFF)) <= uint32(0x7F800000)
            rounded[uint64(k)] = even if is_number else uint32(0x7FC0)
