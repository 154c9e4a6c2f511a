"""Rows of particles, rows of a block, and small matrix products between them, as SIMD that Numba does not find.

A particle is a row of 16 floats, one cache line, in a body ``(R, 16)``. Row ``R`` of a block begins at ``R × LANES`` of
a flat array of float32, one lane a contact. The functions take 16 lanes at a time, from lane ``place`` on; on a machine
with shorter vectors LLVM splits them.
"""

from collections.abc import Callable, Sequence

from llvmlite import ir
from numba import types
from numba.core import cgutils

from gran_bench.neighbors.kernel import INT64, Argument, Emitter, emitted

LANES = 32  # contacts a block: all rows stay in the first-level cache
WIDTH = 16  # lanes of a vector, and floats of a particle's row

_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, WIDTH)
_ACCUMULATORS = 8  # sums that stay in registers at once


def _places(*places: int) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.IntType(32), len(places)), list(places))


class _Lanes(Emitter):
    """Emits loads, stores and sums of vectors."""

    def at(self, array: Argument, *terms: int | ir.Value) -> ir.Value:
        """Address of the element of the flat view whose index is the sum of the terms."""
        known = sum(term for term in terms if isinstance(term, int))
        index = ir.Constant(INT64, known)
        for term in terms:
            if not isinstance(term, int):
                index = self.builder.add(term, index)
        return self.address(array, index)

    def vector(self, pointer: ir.Value) -> ir.Value:
        value = self.builder.load(self.builder.bitcast(pointer, _VECTOR.as_pointer()))
        value.align = 4
        return value

    def put(self, value: ir.Value, pointer: ir.Value) -> None:
        self.builder.store(value, self.builder.bitcast(pointer, _VECTOR.as_pointer())).align = 4

    def all_lanes(self, pointer: ir.Value) -> ir.Value:
        """One float in all lanes."""
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = self.builder.insert_element(undefined, self.builder.load(pointer), ir.Constant(ir.IntType(32), 0))
        return self.builder.shuffle_vector(first, undefined, _places(*[0] * WIDTH))

    def sum_of_product(self, a: ir.Value, b: ir.Value, more: ir.Value) -> ir.Value:
        """a b + more."""
        return self.builder.fadd(self.builder.fmul(a, b, flags=("contract",)), more, flags=("contract",))

    def ends(self, contacts: Argument, contact: ir.Value) -> list[ir.Value]:
        """i and j of a contact."""
        at = self.builder.shl(contact, ir.Constant(INT64, 1))
        return [self.builder.load(self.at(contacts, at, k)) for k in (0, 1)]

    def row(self, body: Argument, particle: ir.Value) -> ir.Value:
        """Address of a particle's row."""
        return self.at(body, self.builder.shl(particle, ir.Constant(INT64, 4)))

    def transposed(self, rows: list[ir.Value]) -> list[ir.Value]:
        """The 16 columns of 16 vectors."""
        shuffle = self.builder.shuffle_vector
        quads = range(0, WIDTH, 4)  # lanes of 128 bits, within which the first two rounds stay

        def halves(a: ir.Value, b: ir.Value, low: Sequence[int], high: Sequence[int]) -> list[ir.Value]:
            chosen = ([q + k % 4 + WIDTH * (k // 4) for q in quads for k in half] for half in (low, high))
            return [shuffle(a, b, _places(*lanes)) for lanes in chosen]

        for apart, low, high in ((1, (0, 4, 1, 5), (2, 6, 3, 7)), (2, (0, 1, 4, 5), (2, 3, 6, 7))):
            rows = [
                vector
                for q in quads
                for k in range(0, 4, 2)
                for vector in halves(rows[q + k // apart], rows[q + k // apart + apart], low, high)
            ]
        columns: list[ir.Value] = [None] * WIDTH
        for k in range(4):
            a, b, c, d = (rows[q + k] for q in quads)
            near, far = [*range(8), *range(16, 24)], [*range(8, 16), *range(24, 32)]
            for first, half in ((0, near), (2, far)):
                x, y = shuffle(a, b, _places(*half)), shuffle(c, d, _places(*half))
                for second in range(2):
                    lanes = [4 * second + 8 * q + m for q in range(4) for m in range(4)]
                    columns[4 * (first + second) + k] = shuffle(x, y, _places(*lanes))
        return columns


def gathering(rows: Sequence[int], first: Sequence[float], second: Sequence[float] | None) -> Callable:
    """An intrinsic that puts ``first`` body[i] + ``second`` body[j] of 16 contacts into rows of a block.

    Factors and ``rows`` are one for each of a row's columns; columns beyond the ``rows`` are left out, and without
    ``second`` j is. The contacts ``begin + place`` … are rows (i, j) of ``(C, 2)`` int64; more repeat ``last − 1``.
    """

    @emitted(types.void, _Lanes)
    def gather(e, b, place, body, contacts, begin, last):
        builder, vectors, place = e.builder, [], e.cast(place)
        end, start = e.cast(last), builder.add(e.cast(begin), place)
        final = builder.sub(end, ir.Constant(INT64, 1))
        for lane in range(WIDTH):
            contact = builder.add(start, ir.Constant(INT64, lane))
            contact = builder.select(builder.icmp_signed("<", contact, end), contact, final)
            i, j = e.ends(contacts, contact)
            vector = builder.fmul(e.vector(e.row(body, i)), _factors(first))
            if second is not None:
                vector = e.sum_of_product(e.vector(e.row(body, j)), _factors(second), vector)
            vectors.append(vector)
        for column, row in zip(e.transposed(vectors), rows, strict=False):
            e.put(column, e.at(b, place, row * LANES))

    return gather


def scattering(rows: Sequence[int], first: Sequence[float], second: Sequence[float] | None) -> Callable:
    """An intrinsic that adds ``first`` times rows of a block to body[i], and ``second`` times to body[j].

    The transposed of :func:`gathering`, contact by contact; what lies beyond ``last`` goes to the row ``spare``.
    """

    @emitted(types.void, _Lanes)
    def scatter(e, body, contacts, begin, last, spare, b, place):
        builder, place, spare = e.builder, e.cast(place), e.cast(spare)
        columns = [e.vector(e.at(b, place, row * LANES)) for row in rows]
        columns += [ir.Constant(_VECTOR, [0.0] * WIDTH)] * (WIDTH - len(rows))
        end, start = e.cast(last), builder.add(e.cast(begin), place)
        final = builder.sub(end, ir.Constant(INT64, 1))
        for lane, vector in enumerate(e.transposed(columns)):
            contact = builder.add(start, ir.Constant(INT64, lane))
            listed = builder.icmp_signed("<", contact, end)
            ends = e.ends(contacts, builder.select(listed, contact, final))
            for particle, factors in zip(ends, (first, second), strict=True):
                if factors is not None:
                    target = e.row(body, builder.select(listed, particle, spare))
                    e.put(e.sum_of_product(vector, _factors(factors), e.vector(target)), target)

    return scatter


def _factors(values: Sequence[float]) -> ir.Constant:
    """One factor a column."""
    return ir.Constant(_VECTOR, [*values, *[0.0] * (WIDTH - len(values))])


@emitted(types.void, _Lanes)
def columns_of(e, b, place, first, body, begin):
    """Rows ``first`` … of a block become the columns of the 16 particles from ``begin + place`` on."""
    rows, corner = _particles(e, body, begin, place), _corner(e, first, place)
    for k, column in enumerate(e.transposed([e.vector(row) for row in rows])):
        e.put(column, e.at(b, corner, k * LANES))


@emitted(types.void, _Lanes)
def rows_of(e, body, begin, b, place, first):
    """The 16 particles from ``begin + place`` on become the columns that rows ``first`` … hold."""
    rows, corner = _particles(e, body, begin, place), _corner(e, first, place)
    columns = [e.vector(e.at(b, corner, k * LANES)) for k in range(WIDTH)]
    for row, value in zip(rows, e.transposed(columns), strict=True):
        e.put(value, row)


@emitted(types.void, _Lanes)
def lanes_of(e, b, place, first, array, row, begin):
    """Row ``first`` of a block becomes what a row of ``(…, C)`` holds from ``begin + place`` on."""
    shape = cgutils.create_struct_proxy(array.kind)(e.context, e.builder, array.value).shape
    length = e.builder.extract_value(shape, 1)
    source = e.at(array, e.builder.mul(e.cast(row), length), e.cast(begin), e.cast(place))
    e.put(e.vector(source), e.at(b, _corner(e, first, place)))


def _particles(e: _Lanes, body: Argument, begin: Argument, place: Argument) -> list[ir.Value]:
    """Addresses of the rows of the 16 particles from ``begin + place`` on."""
    start = e.builder.add(e.cast(begin), e.cast(place))
    return [e.row(body, e.builder.add(start, ir.Constant(INT64, k))) for k in range(WIDTH)]


def _corner(e: _Lanes, first: Argument, place: Argument) -> ir.Value:
    """Index of lane ``place`` of row ``first``."""
    return e.builder.add(e.builder.mul(e.cast(first), ir.Constant(INT64, LANES)), e.cast(place))


def layer(source: int, inputs: int, target: int, outputs: int, strides: tuple[int, int], kind: str) -> Callable:
    """An intrinsic for rows ``target + o`` = Σ_k weight[o × strides[0] + k × strides[1]] × row ``source + k``.

    The ``kind`` says what becomes of a sum: ``rectified`` and ``biased`` start from bias[o], and the rectified one ends
    at 0 where it is negative; ``masked`` is 0 where row ``bias + o`` of the block, a number, is not positive.
    """

    @emitted(types.void, _Lanes)
    def products(e, b, place, weight, bias):
        builder, place, zero = e.builder, e.cast(place), ir.Constant(_VECTOR, [0.0] * WIDTH)
        for begin in range(0, outputs, _ACCUMULATORS):
            units = range(begin, min(begin + _ACCUMULATORS, outputs))
            sums = [zero if kind == "masked" else e.all_lanes(e.at(bias, unit)) for unit in units]
            for k in range(inputs):
                row = e.vector(e.at(b, place, (source + k) * LANES))
                for n, unit in enumerate(units):
                    factor = e.all_lanes(e.at(weight, unit * strides[0] + k * strides[1]))
                    sums[n] = e.sum_of_product(factor, row, sums[n])
            for total, unit in zip(sums, units, strict=True):
                if kind == "rectified":  # not a number stays what it is
                    total = builder.select(builder.fcmp_ordered(">", zero, total), zero, total)
                if kind == "masked" and not isinstance(bias.kind, types.NoneType):
                    mask = builder.add(builder.mul(e.cast(bias), ir.Constant(INT64, LANES)), place)
                    seen = e.vector(e.at(b, mask, unit * LANES))
                    total = builder.select(builder.fcmp_ordered(">", seen, zero), total, zero)
                e.put(total, e.at(b, place, (target + unit) * LANES))

    return products


def outer(units: int, source: int, inputs: int) -> Callable:
    """An intrinsic for result[k, u] += Σ over 16 lanes of row ``source + k`` × row ``units + u``, u up to 16.

    Where ``sums``, ``(16,)``, are given, they gain those of the units.
    """

    @emitted(types.void, _Lanes)
    def add_products(e, b, place, result, sums):
        place = e.cast(place)
        contacts = e.transposed([e.vector(e.at(b, place, (units + u) * LANES)) for u in range(WIDTH)])
        for begin in range(0, inputs, _ACCUMULATORS):
            factors = range(begin, min(begin + _ACCUMULATORS, inputs))
            totals = [e.vector(e.at(result, k * WIDTH)) for k in factors]
            for lane, contact in enumerate(contacts):
                for n, k in enumerate(factors):
                    factor = e.all_lanes(e.at(b, place, (source + k) * LANES + lane))
                    totals[n] = e.sum_of_product(factor, contact, totals[n])
            for total, k in zip(totals, factors, strict=True):
                e.put(total, e.at(result, k * WIDTH))
        if not isinstance(sums.kind, types.NoneType):
            total = e.vector(e.at(sums, 0))
            for contact in contacts:
                total = e.builder.fadd(total, contact)
            e.put(total, e.at(sums, 0))

    return add_products


@emitted(types.void)
def wide(e):
    """Has LLVM use vectors of 64 bytes in the loops of the function where the processor has them."""
    # llvmlite knows few attributes by name and takes no other through its own door.
    set.add(e.builder.function.attributes, '"prefer-vector-width"="512"')
