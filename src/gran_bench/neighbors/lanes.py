"""Eight candidates held against one particle at once; which of them are near comes back as the bits of a byte."""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8


@intrinsic
def near_lanes(typing, x, y, z, r, first, xa, ya, za, reach, period, inverse_period):
    """Bit k is set where ‖(x, y, z)[first + k] − (xa, ya, za)‖ < r[first + k] + reach, y to the nearest image.

    The arrays are contiguous float64 with at least ``first + 8`` elements; a period of 0, and an inverse of 0 with it,
    wraps nothing.
    """
    signature = types.uint64(x, y, z, r, first, xa, ya, za, reach, period, inverse_period)

    def emit(context, builder, signature, values):
        lanes = ir.VectorType(ir.DoubleType(), LANES)

        def load(argument: int) -> ir.Value:
            array = cgutils.create_struct_proxy(signature.args[argument])(context, builder, values[argument])
            index = context.cast(builder, values[4], signature.args[4], types.int64)
            pointer = builder.bitcast(builder.gep(array.data, [index]), lanes.as_pointer())
            value = builder.load(pointer)
            value.align = 8
            return value

        def spread(argument: int) -> ir.Value:
            wide = context.cast(builder, values[argument], signature.args[argument], types.float64)
            vector = ir.Constant(lanes, [0.0] * LANES)
            for lane in range(LANES):
                vector = builder.insert_element(vector, wide, ir.Constant(ir.IntType(32), lane))
            return vector

        dx, dy, dz = (builder.fsub(load(axis), spread(5 + axis)) for axis in range(3))
        round_to_whole = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(lanes, [lanes]), f"llvm.rint.v{LANES}f64"
        )
        images = builder.call(round_to_whole, [builder.fmul(dy, spread(10))])
        dy = builder.fsub(dy, builder.fmul(spread(9), images))
        closer = builder.fadd(load(3), spread(8))
        squared = builder.fadd(builder.fadd(builder.fmul(dx, dx), builder.fmul(dy, dy)), builder.fmul(dz, dz))
        near = builder.fcmp_ordered("<", squared, builder.fmul(closer, closer))
        return builder.zext(builder.bitcast(near, ir.IntType(LANES)), ir.IntType(64))

    return signature, emit


@intrinsic
def lowest_lane(typing, hits):
    """Number of the lowest set bit."""

    def emit(context, builder, signature, values):
        return builder.cttz(values[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uint64), emit


@intrinsic
def clear_lowest(typing, hits):
    """The bits without the lowest set one."""

    def emit(context, builder, signature, values):
        return builder.and_(values[0], builder.sub(values[0], ir.Constant(ir.IntType(64), 1)))

    return types.uint64(types.uint64), emit
