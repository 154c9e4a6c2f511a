"""Rows of four and columns of a block: SIMD loads, transposes and stores that Numba does not find by itself.

Bodies are rows of four doubles in arrays ``(N, 4)``; column c of a block begins at ``c × BLOCK`` of a flat buffer of
float64 or float32, one lane a contact. These functions carry four contacts at a time from one to the other.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils

from gran_bench.neighbors.kernel import DOUBLE, INT64, Argument, Emitter, emitted

BLOCK = 64  # contacts of a block: its buffer stays in the first-level cache

_LANES = 4
_QUAD = ir.VectorType(DOUBLE, _LANES)


def _lanes(*places: int) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.IntType(32), len(places)), list(places))


class _Rows(Emitter):
    """Emits loads and stores of rows of four, and of four lanes of a column."""

    def row(self, body: Argument, index: Argument, lane: int | None = None) -> ir.Value:
        """Address of a row of an ``(N, 4)`` array; of one of four rows where a lane is given."""
        if lane is not None:
            index = Argument(index.kind.dtype, self.builder.extract_value(index.value, lane))
        return self.address(body, self.builder.shl(self.cast(index, types.uint64), ir.Constant(INT64, 2)))

    def rows(self, body: Argument, index: Argument) -> list[ir.Value]:
        """What four rows hold."""
        return [self.load(self.row(body, index, lane), _LANES) for lane in range(_LANES)]

    def column(self, buffer: Argument, first: Argument, place: Argument, extra: int) -> ir.Value:
        """Address of lane ``place`` of column ``first + extra``."""
        column = self.builder.add(self.cast(first), ir.Constant(INT64, extra))
        return self.address(
            buffer, self.builder.add(self.builder.mul(column, ir.Constant(INT64, BLOCK)), self.cast(place))
        )

    def to_columns(self, rows: list[ir.Value], buffer: Argument, first: Argument, place: Argument) -> None:
        """Four rows become four columns at lanes ``place`` …"""
        for extra, column in enumerate(self.transposed(rows)):
            self.store(column, self.column(buffer, first, place, extra))

    def from_columns(self, buffer: Argument, first: Argument, place: Argument) -> list[ir.Value]:
        """Four columns at lanes ``place`` … as four rows."""
        return self.transposed([self.load(self.column(buffer, first, place, k), _LANES) for k in range(4)])

    def add(self, gain: ir.Value, target: ir.Value, operation: str = "fadd") -> None:
        """Adds to a row where it is stored, or takes from it."""
        self.store(getattr(self.builder, operation)(self.load(target, _LANES), gain), target)

    def store(self, value: ir.Value, pointer: ir.Value) -> None:
        """Four doubles, narrowed to what the array holds."""
        element = pointer.type.pointee
        vector = ir.VectorType(element, _LANES)
        value = value if element == DOUBLE else self.builder.fptrunc(value, vector)
        store = self.builder.store(value, self.builder.bitcast(pointer, vector.as_pointer()))
        store.align = element.get_abi_size(self.context.target_data)

    def transposed(self, rows: list[ir.Value]) -> list[ir.Value]:
        """The four columns of four rows."""
        (a, b, c, d), shuffle = rows, self.builder.shuffle_vector
        even_low, odd_low = shuffle(a, b, _lanes(0, 4, 2, 6)), shuffle(a, b, _lanes(1, 5, 3, 7))
        even_high, odd_high = shuffle(c, d, _lanes(0, 4, 2, 6)), shuffle(c, d, _lanes(1, 5, 3, 7))
        low, high = _lanes(0, 1, 4, 5), _lanes(2, 3, 6, 7)
        return [
            shuffle(even, odd, half)
            for half in (low, high)
            for even, odd in ((even_low, even_high), (odd_low, odd_high))
        ]


@emitted(lambda array, begin: types.UniTuple(array.dtype, _LANES))
def four_from(e, array, begin):
    """array[begin], …, array[begin + 3] as a tuple."""
    first = e.cast(begin)
    places = [e.builder.add(first, ir.Constant(INT64, lane)) for lane in range(_LANES)]
    return cgutils.pack_array(e.builder, [e.builder.load(e.address(array, place)) for place in places])


@emitted(lambda begin: types.UniTuple(begin, _LANES))
def four_on(e, begin):
    """begin, …, begin + 3 as a tuple."""
    steps = [ir.Constant(begin.value.type, lane) for lane in range(_LANES)]
    return cgutils.pack_array(e.builder, [e.builder.add(begin.value, step) for step in steps])


@emitted(lambda array, places: types.UniTuple(array.dtype, _LANES))
def four_of(e, array, places):
    """array[places[0]], …, array[places[3]] as a tuple."""
    found = [Argument(places.kind.dtype, e.builder.extract_value(places.value, lane)) for lane in range(_LANES)]
    return cgutils.pack_array(e.builder, [e.builder.load(e.address(array, e.cast(p, types.uint64))) for p in found])


@emitted(lambda memory, places, touched, end: types.UniTuple(memory.dtype, _LANES))
def four_remembered(e, memory, places, touched, end):
    """For each of four places the row r = memory[place] where touched[r] is that place and r < end, else 0."""
    rows, builder, end = [], e.builder, e.cast(end)
    for lane in range(_LANES):
        place = Argument(places.kind.dtype, builder.extract_value(places.value, lane))
        row = builder.load(e.address(memory, e.cast(place, types.uint64)))
        wide = e.cast(Argument(memory.kind.dtype, row))
        same = builder.icmp_unsigned("==", builder.load(e.address(touched, wide)), place.value)
        known = builder.and_(same, builder.icmp_signed("<", wide, end))
        rows.append(builder.select(known, row, ir.Constant(row.type, 0)))
    return cgutils.pack_array(builder, rows)


@emitted(types.void, _Rows)
def gather_rows(e, buffer, first, place, body, i):
    """Columns ``first`` … ``first + 3`` at lanes ``place`` … ``place + 3`` become body[i]."""
    e.to_columns(e.rows(body, i), buffer, first, place)


def _gathered(operation: str):
    """An intrinsic as `gather_rows` of two rows of a body, body[i] and body[j], added or subtracted."""

    def gather(e, buffer, first, place, body, i, j):
        e.to_columns(list(map(getattr(e.builder, operation), e.rows(body, i), e.rows(body, j))), buffer, first, place)

    return emitted(types.void, _Rows)(gather)


gather_difference, gather_sum = _gathered("fsub"), _gathered("fadd")


@emitted(types.void, _Rows)
def scatter_rows(e, body, i, buffer, first, place):
    """body[i] becomes what columns ``first`` … ``first + 3`` hold at lanes ``place`` … ``place + 3``."""
    for lane, row in enumerate(e.from_columns(buffer, first, place)):
        e.store(row, e.row(body, i, lane))


@emitted(types.void, _Rows)
def scatter_sum(e, body, i, buffer, first, place):
    """body[i] gains columns ``first`` … ``first + 3`` at lanes ``place`` …, contact by contact."""
    for lane, gain in enumerate(e.from_columns(buffer, first, place)):
        e.add(gain, e.row(body, i, lane))


@emitted(types.void, _Rows)
def scatter_opposite(e, body, i, j, buffer, first, place):
    """body[i] gains columns ``first`` … ``first + 3`` at lanes ``place`` …, body[j] loses them, contact by contact."""
    for lane, gain in enumerate(e.from_columns(buffer, first, place)):
        e.add(gain, e.row(body, i, lane))
        e.add(gain, e.row(body, j, lane), "fsub")


@emitted(types.void, _Rows)
def scatter_both(e, body, i, j, buffer, first, second, place):
    """body[i] gains columns ``first`` …, body[j] columns ``second`` …, at lanes ``place`` …, contact by contact."""
    gains = zip(e.from_columns(buffer, first, place), e.from_columns(buffer, second, place), strict=True)
    for lane, (one, other) in enumerate(gains):
        e.add(one, e.row(body, i, lane))
        e.add(other, e.row(body, j, lane))


@emitted(types.float64, _Rows)
def squared_gap(e, sphere, i, j):
    """‖x_j − x_i‖² − (r_i + r_j)² of two rows (x, y, z, r), m²; negative where the spheres overlap."""
    builder = e.builder
    first, second = e.load(e.row(sphere, i), _LANES), e.load(e.row(sphere, j), _LANES)
    # Differences of the coordinates and the sum of the radii at once.
    gap = builder.fadd(second, builder.fmul(first, ir.Constant(_QUAD, [-1.0, -1.0, -1.0, 1.0])))
    gap = builder.fmul(builder.fmul(gap, gap), ir.Constant(_QUAD, [1.0, 1.0, 1.0, -1.0]))
    pair = builder.fadd(builder.shuffle_vector(gap, gap, _lanes(0, 1)), builder.shuffle_vector(gap, gap, _lanes(2, 3)))
    return builder.fadd(*(builder.extract_element(pair, ir.Constant(ir.IntType(32), k)) for k in (0, 1)))


@emitted(types.void, _Rows)
def kick_row(e, body, load, i, gx, gy, gz, closing, ahead, opening):
    """body[i] += closing × a, then body[i] += opening × a = ahead[i], with a = body[i, 3] load[i] + g; load[i] = 0."""
    gravity = ir.Constant(_QUAD, [0.0] * _LANES)
    for axis, component in enumerate((gx, gy, gz)):
        gravity = e.builder.insert_element(gravity, component.value, ir.Constant(ir.IntType(32), axis))
    e.store(_kick(e, body, load, i, gravity, closing, opening), e.row(ahead, i))


@emitted(types.void, _Rows)
def twist_row(e, body, load, i, closing, opening):
    """The same without g and ahead."""
    _kick(e, body, load, i, None, closing, opening)


@emitted(types.void, _Rows)
def twist_row_ahead(e, body, load, i, closing, ahead, opening):
    """`twist_row` that keeps opening × a = ahead[i]."""
    e.store(_kick(e, body, load, i, None, closing, opening), e.row(ahead, i))


def _kick(e, body, load, i, gravity, closing, opening) -> ir.Value:
    """Emits two kicks; returns what the second adds."""
    builder, place, source = e.builder, e.row(body, i), e.row(load, i)
    row = e.load(place, _LANES)
    acceleration = builder.fmul(builder.shuffle_vector(row, row, _lanes(3, 3, 3, 3)), e.load(source, _LANES))
    if gravity is not None:
        acceleration = builder.fadd(acceleration, gravity)
    gain = builder.fmul(e.spread(opening.value, _LANES), acceleration)
    whole = builder.fadd(row, builder.fmul(e.spread(closing.value, _LANES), acceleration))
    e.store(builder.fadd(whole, gain), place)
    e.store(ir.Constant(_QUAD, [0.0] * _LANES), source)
    return gain


@emitted(types.void, _Rows)
def drift_row(e, sphere, velocity, i, dt):
    """sphere[i] += dt × velocity[i], but for the radius."""
    times = e.builder.insert_element(
        e.spread(dt.value, _LANES), ir.Constant(DOUBLE, 0.0), ir.Constant(ir.IntType(32), 3)
    )
    e.add(e.builder.fmul(times, e.load(e.row(velocity, i), _LANES)), e.row(sphere, i))


@emitted(types.void, _Rows)
def move_row(e, source, target, i):
    """target[i] += source[i]; source[i] = 0."""
    origin = e.row(source, i)
    e.add(e.load(origin, _LANES), e.row(target, i))
    e.store(ir.Constant(_QUAD, [0.0] * _LANES), origin)
