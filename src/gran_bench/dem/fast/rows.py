"""Rows of four and columns of a block: SIMD loads, transposes and stores that Numba does not find by itself.

Bodies are rows of four doubles in arrays ``(N, 4)``; the laws run over columns, one lane a contact, in a flat buffer
whose column c begins at ``c × BLOCK``. These intrinsics carry four contacts at a time from one to the other. They take
the place of loops like ``for lane, c: buffer[(first + c) * BLOCK + k + lane] = a[i[lane], c] - a[j[lane], c]`` and are
held against such loops in tests. The buffer may be float32 while the bodies are float64.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

BLOCK = 64  # contacts of a block: its buffer stays in the first-level cache

_LANES = 4


class _Writer:
    """Emits loads and stores of four neighbouring elements."""

    def __init__(self, context, builder, signature, arguments) -> None:
        self.context, self.builder, self.signature, self.arguments = context, builder, signature, arguments

    def pointer(self, argument: int, index: ir.Value) -> ir.Value:
        """Address of element ``index`` of the flat view of an array argument."""
        array = cgutils.create_struct_proxy(self.signature.args[argument])(
            self.context, self.builder, self.arguments[argument]
        )
        return self.builder.gep(array.data, [index])

    def row(self, argument: int, index_argument: int, lane: int | None = None) -> ir.Value:
        """Address of row ``index`` of an ``(N, 4)`` argument; of one of the four where a lane is given."""
        index, kind = self.arguments[index_argument], self.signature.args[index_argument]
        if lane is not None:
            index, kind = self.builder.extract_value(index, lane), kind.dtype
        index = self.context.cast(self.builder, index, kind, types.uint64)
        return self.pointer(argument, self.builder.shl(index, ir.Constant(ir.IntType(64), 2)))

    def column(self, argument: int, column_argument: int, place_argument: int, extra: int) -> ir.Value:
        """Address of lane ``place`` of column ``first + extra`` of a block buffer."""
        sixty_four, builder = ir.IntType(64), self.builder
        column, place = (
            self.context.cast(builder, self.arguments[a], self.signature.args[a], types.int64)
            for a in (column_argument, place_argument)
        )
        column = builder.add(column, ir.Constant(sixty_four, extra))
        return self.pointer(argument, builder.add(builder.mul(column, ir.Constant(sixty_four, BLOCK)), place))

    def load(self, pointer: ir.Value) -> ir.Value:
        """Four elements, as doubles."""
        element = pointer.type.pointee
        vector = ir.VectorType(element, _LANES)
        value = self.builder.load(self.builder.bitcast(pointer, vector.as_pointer()))
        value.align = element.get_abi_size(self.context.target_data)
        wide = ir.VectorType(ir.DoubleType(), _LANES)
        return value if element == ir.DoubleType() else self.builder.fpext(value, wide)

    def store(self, value: ir.Value, pointer: ir.Value) -> None:
        """Four doubles, narrowed to what the array holds."""
        element = pointer.type.pointee
        vector = ir.VectorType(element, _LANES)
        if element != ir.DoubleType():
            value = self.builder.fptrunc(value, vector)
        store = self.builder.store(value, self.builder.bitcast(pointer, vector.as_pointer()))
        store.align = element.get_abi_size(self.context.target_data)

    def spread(self, value: ir.Value) -> ir.Value:
        """A double in all four lanes."""
        vector = ir.Constant(ir.VectorType(ir.DoubleType(), _LANES), [0.0] * _LANES)
        for lane in range(_LANES):
            vector = self.builder.insert_element(vector, value, ir.Constant(ir.IntType(32), lane))
        return vector

    def transposed(self, rows: list[ir.Value]) -> list[ir.Value]:
        """The four columns of four rows."""

        def shuffle(a: ir.Value, b: ir.Value, *places: int) -> ir.Value:
            mask = ir.Constant(ir.VectorType(ir.IntType(32), _LANES), list(places))
            return self.builder.shuffle_vector(a, b, mask)

        a, b, c, d = rows
        even_low, odd_low = shuffle(a, b, 0, 4, 2, 6), shuffle(a, b, 1, 5, 3, 7)
        even_high, odd_high = shuffle(c, d, 0, 4, 2, 6), shuffle(c, d, 1, 5, 3, 7)
        return [
            shuffle(even_low, even_high, 0, 1, 4, 5),
            shuffle(odd_low, odd_high, 0, 1, 4, 5),
            shuffle(even_low, even_high, 2, 3, 6, 7),
            shuffle(odd_low, odd_high, 2, 3, 6, 7),
        ]


@intrinsic
def four_from(typing, array, begin):
    """array[begin], …, array[begin + 3] as a tuple."""

    def emit(context, builder, signature, values):
        writer = _Writer(context, builder, signature, values)
        begin = context.cast(builder, values[1], signature.args[1], types.int64)
        places = [builder.add(begin, ir.Constant(ir.IntType(64), lane)) for lane in range(_LANES)]
        return cgutils.pack_array(builder, [builder.load(writer.pointer(0, place)) for place in places])

    return types.UniTuple(array.dtype, _LANES)(array, begin), emit


@intrinsic
def four_on(typing, begin):
    """begin, …, begin + 3 as a tuple."""

    def emit(context, builder, signature, values):
        places = [builder.add(values[0], ir.Constant(values[0].type, lane)) for lane in range(_LANES)]
        return cgutils.pack_array(builder, places)

    return types.UniTuple(begin, _LANES)(begin), emit


@intrinsic
def four_of(typing, array, places):
    """array[places[0]], …, array[places[3]] as a tuple."""

    def emit(context, builder, signature, values):
        writer, kind = _Writer(context, builder, signature, values), signature.args[1].dtype
        loads = []
        for lane in range(_LANES):
            place = context.cast(builder, builder.extract_value(values[1], lane), kind, types.uint64)
            loads.append(builder.load(writer.pointer(0, place)))
        return cgutils.pack_array(builder, loads)

    return types.UniTuple(array.dtype, _LANES)(array, places), emit


@intrinsic
def four_remembered(typing, memory, places, touched, end):
    """For each of four places the row r = memory[place] where touched[r] is that place and r < end, else 0."""

    def emit(context, builder, signature, values):
        writer = _Writer(context, builder, signature, values)
        end = context.cast(builder, values[3], signature.args[3], types.int64)
        rows = []
        for lane in range(_LANES):
            place = builder.extract_value(values[1], lane)
            index = context.cast(builder, place, signature.args[1].dtype, types.uint64)
            row = builder.load(writer.pointer(0, index))
            wide = context.cast(builder, row, signature.args[0].dtype, types.int64)
            same = builder.icmp_unsigned("==", builder.load(writer.pointer(2, wide)), place)
            known = builder.and_(same, builder.icmp_signed("<", wide, end))
            rows.append(builder.select(known, row, ir.Constant(row.type, 0)))
        return cgutils.pack_array(builder, rows)

    return types.UniTuple(memory.dtype, _LANES)(memory, places, touched, end), emit


def _gather(combine: str | None, arguments: tuple[types.Type, ...]):
    """Signature and code that bring body[i] ∘ body[j] (or body[i] alone) of four contacts into four columns."""

    def emit(context, builder, signature, values):
        writer = _Writer(context, builder, signature, values)
        rows = [writer.load(writer.row(3, 4, lane)) for lane in range(_LANES)]
        if combine is not None:
            others = [writer.load(writer.row(3, 5, lane)) for lane in range(_LANES)]
            rows = [getattr(builder, combine)(row, other) for row, other in zip(rows, others, strict=True)]
        for extra, column in enumerate(writer.transposed(rows)):
            writer.store(column, writer.column(0, 1, 2, extra))
        return context.get_dummy_value()

    return types.void(*arguments), emit


@intrinsic
def gather_difference(typing, buffer, first, place, body, i, j):
    """Columns ``first`` … ``first + 3`` at lanes ``place`` … ``place + 3`` become body[i] − body[j]."""
    return _gather("fsub", (buffer, first, place, body, i, j))


@intrinsic
def gather_sum(typing, buffer, first, place, body, i, j):
    """Columns ``first`` … ``first + 3`` at lanes ``place`` … ``place + 3`` become body[i] + body[j]."""
    return _gather("fadd", (buffer, first, place, body, i, j))


@intrinsic
def gather_rows(typing, buffer, first, place, body, i):
    """Columns ``first`` … ``first + 3`` at lanes ``place`` … ``place + 3`` become body[i]."""
    return _gather(None, (buffer, first, place, body, i))


@intrinsic
def scatter_rows(typing, body, i, buffer, first, place):
    """body[i] becomes what columns ``first`` … ``first + 3`` hold at lanes ``place`` … ``place + 3``."""

    def emit(context, builder, signature, values):
        writer = _Writer(context, builder, signature, values)
        columns = [writer.load(writer.column(2, 3, 4, extra)) for extra in range(4)]
        for lane, row in enumerate(writer.transposed(columns)):
            writer.store(row, writer.row(0, 1, lane))
        return context.get_dummy_value()

    return types.void(*(body, i, buffer, first, place)), emit


@intrinsic
def scatter_sum(typing, body, i, buffer, first, place):
    """body[i] gains columns ``first`` … ``first + 3`` at lanes ``place`` …, contact by contact."""

    def emit(context, builder, signature, values):
        writer = _Writer(context, builder, signature, values)
        columns = [writer.load(writer.column(2, 3, 4, extra)) for extra in range(4)]
        for lane, gain in enumerate(writer.transposed(columns)):
            target = writer.row(0, 1, lane)
            writer.store(builder.fadd(writer.load(target), gain), target)
        return context.get_dummy_value()

    return types.void(*(body, i, buffer, first, place)), emit


@intrinsic
def scatter_opposite(typing, body, i, j, buffer, first, place):
    """body[i] gains columns ``first`` … ``first + 3`` at lanes ``place`` …, body[j] loses them, contact by contact."""

    def emit(context, builder, signature, values):
        writer = _Writer(context, builder, signature, values)
        gains = writer.transposed([writer.load(writer.column(3, 4, 5, extra)) for extra in range(4)])
        for lane, gain in enumerate(gains):
            first, second = writer.row(0, 1, lane), writer.row(0, 2, lane)
            writer.store(builder.fadd(writer.load(first), gain), first)
            writer.store(builder.fsub(writer.load(second), gain), second)
        return context.get_dummy_value()

    return types.void(*(body, i, j, buffer, first, place)), emit


@intrinsic
def scatter_both(typing, body, i, j, buffer, first, second, place):
    """body[i] gains columns ``first`` …, body[j] columns ``second`` …, at lanes ``place`` …, contact by contact."""

    def emit(context, builder, signature, values):
        writer = _Writer(context, builder, signature, values)
        gains = (
            writer.transposed([writer.load(writer.column(3, start, 6, extra)) for extra in range(4)])
            for start in (4, 5)
        )
        for lane, pair in enumerate(zip(*gains, strict=True)):
            for side, gain in zip((1, 2), pair, strict=True):
                target = writer.row(0, side, lane)
                writer.store(builder.fadd(writer.load(target), gain), target)
        return context.get_dummy_value()

    return types.void(*(body, i, j, buffer, first, second, place)), emit


@intrinsic
def squared_gap(typing, sphere, i, j):
    """‖x_j − x_i‖² − (r_i + r_j)² of two rows (x, y, z, r), m²; negative where the spheres overlap."""

    def emit(context, builder, signature, values):
        writer, double = _Writer(context, builder, signature, values), ir.DoubleType()
        quad = ir.VectorType(double, _LANES)
        first, second = writer.load(writer.row(0, 1)), writer.load(writer.row(0, 2))
        # Differences of the coordinates and the sum of the radii at once.
        gap = builder.fadd(second, builder.fmul(first, ir.Constant(quad, [-1.0, -1.0, -1.0, 1.0])))
        gap = builder.fmul(builder.fmul(gap, gap), ir.Constant(quad, [1.0, 1.0, 1.0, -1.0]))
        low, high = (
            builder.shuffle_vector(gap, gap, ir.Constant(ir.VectorType(ir.IntType(32), 2), places))
            for places in ([0, 1], [2, 3])
        )
        pair = builder.fadd(low, high)
        return builder.fadd(*(builder.extract_element(pair, ir.Constant(ir.IntType(32), k)) for k in (0, 1)))

    return types.float64(sphere, i, j), emit


@intrinsic
def kick_row(typing, body, load, i, gx, gy, gz, closing, ahead, opening):
    """body[i] += closing × a, then body[i] += opening × a, with a = body[i, 3] load[i] + g; load[i] = 0.

    Rounded in between, as where a step ends. ahead[i] becomes opening × a. The fourth place of a body is its 1/m or
    1/I, and stays: the fourth of a load is zero.
    """

    def emit(context, builder, signature, values):
        writer = _Writer(context, builder, signature, values)
        gain = _kick(writer, 1, 2, values[3:6], values[6], values[8])
        writer.store(gain, writer.row(7, 2))
        return context.get_dummy_value()

    return types.void(*(body, load, i, gx, gy, gz, closing, ahead, opening)), emit


@intrinsic
def twist_row(typing, body, load, i, closing, opening):
    """body[i] += closing × a, then body[i] += opening × a, with a = body[i, 3] load[i]; load[i] = 0."""

    def emit(context, builder, signature, values):
        _kick(_Writer(context, builder, signature, values), 1, 2, None, values[3], values[4])
        return context.get_dummy_value()

    return types.void(body, load, i, closing, opening), emit


@intrinsic
def move_row(typing, source, target, i):
    """target[i] += source[i]; source[i] = 0."""

    def emit(context, builder, signature, values):
        writer = _Writer(context, builder, signature, values)
        origin, destination = writer.row(0, 2), writer.row(1, 2)
        writer.store(builder.fadd(writer.load(destination), writer.load(origin)), destination)
        writer.store(ir.Constant(ir.VectorType(ir.DoubleType(), _LANES), [0.0] * _LANES), origin)
        return context.get_dummy_value()

    return types.void(source, target, i), emit


def _kick(writer: _Writer, load: int, index: int, gravity, closing, opening):
    """Emits two kicks of the first argument by argument ``load``; returns what the second adds."""
    builder, quad = writer.builder, ir.VectorType(ir.DoubleType(), _LANES)
    place, source = writer.row(0, index), writer.row(load, index)
    row = writer.load(place)
    inverse = builder.shuffle_vector(row, row, ir.Constant(ir.VectorType(ir.IntType(32), _LANES), [3] * _LANES))
    acceleration = builder.fmul(inverse, writer.load(source))
    if gravity is not None:
        g = ir.Constant(quad, [0.0] * _LANES)
        for axis, component in enumerate(gravity):
            g = builder.insert_element(g, component, ir.Constant(ir.IntType(32), axis))
        acceleration = builder.fadd(acceleration, g)
    gain = builder.fmul(writer.spread(opening), acceleration)
    whole = builder.fadd(row, builder.fmul(writer.spread(closing), acceleration))
    writer.store(builder.fadd(whole, gain), place)
    writer.store(ir.Constant(quad, [0.0] * _LANES), source)
    return gain
