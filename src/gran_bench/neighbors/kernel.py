"""How pieces that run for every particle are jitted, and pieces of LLVM as functions of jitted code."""

import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

# Divisions may not raise, so that loops with them run in SIMD. Wrappers for Python, which is not to call it, would take
# a tenth of the time of the first compilation.
kernel = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


def cached(*rooms: Path, **options) -> Callable[[Callable], Callable]:
    """Compile a function, with options of ``numba.njit``, and keep it on disk, named by a digest of its ``rooms``.

    Numba keys its cache by the function's own file: what changed in another would be found under the old key.
    """
    files = [path for room in rooms for path in sorted(room.rglob("*.py"))]
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()

    def jitted(function: Callable) -> Callable:
        function.__qualname__ = f"{function.__name__}_{digest[:16]}"
        return njit(cache=True, error_model="numpy", **options)(function)

    return jitted


# What Python calls, of the searches and of the fast engine; it lets other threads run meanwhile.
entry = cached(*(Path(__file__).parents[1] / room for room in ("neighbors", "dem")), nogil=True)

LANES, WORD = 8, 64  # candidates that near_lanes holds against one particle, and bits of a uint64
INT64, DOUBLE = ir.IntType(64), ir.DoubleType()


class Argument(NamedTuple):
    """An argument of an intrinsic: Numba's type and LLVM's value."""

    kind: types.Type
    value: ir.Value


class Emitter:
    """What the intrinsics have in common: addresses in arrays, casts, vectors of doubles."""

    def __init__(self, context, builder) -> None:
        self.context, self.builder = context, builder

    def cast(self, argument: Argument, kind: types.Type = types.int64) -> ir.Value:
        """An argument as a value of another type."""
        return self.context.cast(self.builder, argument.value, argument.kind, kind)

    def address(self, array: Argument, index: ir.Value) -> ir.Value:
        """Of element ``index`` of the flat view of an array."""
        data = cgutils.create_struct_proxy(array.kind)(self.context, self.builder, array.value).data
        return self.builder.gep(data, [index])

    def load(self, pointer: ir.Value, lanes: int) -> ir.Value:
        """Neighbouring elements, as doubles."""
        element = pointer.type.pointee
        value = self.builder.load(self.builder.bitcast(pointer, ir.VectorType(element, lanes).as_pointer()))
        value.align = element.get_abi_size(self.context.target_data)
        return value if element == DOUBLE else self.builder.fpext(value, ir.VectorType(DOUBLE, lanes))

    def spread(self, value: ir.Value, lanes: int) -> ir.Value:
        """A double in all lanes."""
        vector = ir.Constant(ir.VectorType(DOUBLE, lanes), [0.0] * lanes)
        for lane in range(lanes):
            vector = self.builder.insert_element(vector, value, ir.Constant(ir.IntType(32), lane))
        return vector


def emitted(result: types.Type | Callable[..., types.Type], emitter: type[Emitter] = Emitter) -> Callable:
    """Make an intrinsic of a function that emits its code from an emitter and its arguments.

    The result is a type, or a function of the arguments' types that gives it.
    """

    def decorate(emit: Callable):
        def typed(typing, *kinds):
            def code(context, builder, signature, values):
                found = emit(emitter(context, builder), *map(Argument, signature.args, values))
                return context.get_dummy_value() if found is None else found

            return (result if isinstance(result, types.Type) else result(*kinds))(*kinds), code

        typed.__name__, typed.__signature__ = emit.__name__, inspect.signature(emit)
        return intrinsic(typed)

    return decorate


@emitted(types.uint64)
def near_lanes(e, x, y, z, r, first, xa, ya, za, reach, period, inverse_period):
    """Bit k is set where ‖(x, y, z)[first + k] − (xa, ya, za)‖ < r[first + k] + reach, y to the nearest image.

    The arrays are contiguous float64 with at least ``first + 8`` elements; where the period is None, nothing wraps.
    """
    builder, begin = e.builder, e.cast(first)
    lanes = ir.VectorType(DOUBLE, LANES)

    def lanes_of(array: Argument) -> ir.Value:
        return e.load(e.address(array, begin), LANES)

    def all_lanes(number: Argument) -> ir.Value:
        return e.spread(e.cast(number, types.float64), LANES)

    dx, dy, dz = (builder.fsub(lanes_of(a), all_lanes(b)) for a, b in ((x, xa), (y, ya), (z, za)))
    if not isinstance(period.kind, types.NoneType):
        name = f"llvm.rint.v{LANES}f64"
        rint = cgutils.get_or_insert_function(builder.module, ir.FunctionType(lanes, [lanes]), name)
        images = builder.call(rint, [builder.fmul(dy, all_lanes(inverse_period))])
        dy = builder.fsub(dy, builder.fmul(all_lanes(period), images))
    closer = builder.fadd(lanes_of(r), all_lanes(reach))
    squared = builder.fadd(builder.fadd(builder.fmul(dx, dx), builder.fmul(dy, dy)), builder.fmul(dz, dz))
    near = builder.fcmp_ordered("<", squared, builder.fmul(closer, closer))
    return builder.zext(builder.bitcast(near, ir.IntType(LANES)), INT64)


@emitted(types.int64)
def lowest_lane(e, hits):
    """Number of the lowest set bit of a uint64."""
    return e.builder.cttz(hits.value, ir.Constant(ir.IntType(1), 1))


@emitted(types.uint64)
def clear_lowest(e, hits):
    """The bits of a uint64 without the lowest set one."""
    return e.builder.and_(hits.value, e.builder.sub(hits.value, ir.Constant(INT64, 1)))
