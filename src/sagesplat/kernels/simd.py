"""Vectors in numba kernels: f16 and f8 (float32), d8 (float64), with the operators of numbers.

LLVM vectorises a loop when it can prove enough about it and guesses that it pays; the kernels of a training
step are too precious for guesses. An `f16` is one register of AVX-512, two of AVX2, four of NEON: LLVM splits
it to what the machine has. Comparisons give masks for `where`. A number beside a vector stands in all lanes.
Memory is addressed flat, in elements, and never checked.
"""

import math
import operator
import os
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numba.extending
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing import templates
from numba.core.typing.templates import AbstractTemplate, signature
from numba.extending import lower_builtin, models, register_model

# their types say less than what they do
infer_global: Any = templates.infer_global
intrinsic: Any = numba.extending.intrinsic

_INT = ir.IntType(32)
# No assumption that NaN or Inf do not occur, and no other order of sums: numba optimises a kernel once more
# when it caches it, and what may be reordered would then have other bits than where it was compiled.
_FLAGS = ("contract", "nsz", "arcp")
_ELEMENTS = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}


class Vector(types.Type):
    """Type of a vector in numba's type system."""

    def __init__(self, element: types.Float, lanes: int) -> None:
        self.element, self.lanes = element, lanes
        self.code = f"v{lanes}f{element.bitwidth}"  # what LLVM appends to the names of intrinsics
        self.llvm = ir.VectorType(_ELEMENTS[element], lanes)
        super().__init__(f"Vector({self.code})")

    @property
    def integers(self) -> ir.VectorType:
        """LLVM's vector of integers as wide."""
        return ir.VectorType(ir.IntType(self.element.bitwidth), self.lanes)

    def integer(self, value: int) -> ir.Constant:
        """`value` in all lanes of the vector of integers."""
        return ir.Constant(self.integers, [value] * self.lanes)

    def constant(self, value: float) -> ir.Constant:
        """`value` in all lanes."""
        return ir.Constant(self.llvm, [float(np.dtype(str(self.element)).type(value))] * self.lanes)


class Mask(types.Type):
    """Type of a vector of truth values."""

    def __init__(self, lanes: int) -> None:
        self.lanes, self.llvm = lanes, ir.VectorType(ir.IntType(1), lanes)
        super().__init__(f"Mask({lanes})")


f16, f8, d8 = Vector(types.float32, 16), Vector(types.float32, 8), Vector(types.float64, 8)
_WIDE = llvmlite.binding.get_host_cpu_features().get("avx512f", False)
LANES = int(os.environ.get("SAGESPLAT_LANES", 16 if _WIDE else 8))  # the variable is for tests


@register_model(Vector)
@register_model(Mask)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.llvm)


def _repeat(builder: Any, value: Any, lanes: int) -> Any:
    kind = ir.VectorType(value.type, lanes)
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_INT, 0))
    order = ir.Constant(ir.VectorType(_INT, lanes), [0] * lanes)
    return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), order)


def _in_all_lanes(context: Any, builder: Any, value: Any, kind: Any, vector: Vector) -> Any:
    if kind == vector:
        return value
    return _repeat(builder, context.cast(builder, value, kind, vector.element), vector.lanes)


def _call(builder: Any, name: str, result: Any, *values: Any, **options: Any) -> Any:
    kind = ir.FunctionType(result, [v.type for v in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values, **options)


# Operators -----------------------------------------------------------------------------------------------

_Emit = Callable[[Any, Any, Any], Any]


def _vector_of(args: Any) -> Vector | None:
    """The one vector type among an operator's arguments; the others must be numbers."""
    vectors = {a for a in args if isinstance(a, Vector)}
    others = [a for a in args if not isinstance(a, Vector | types.Number)]
    return vectors.pop() if len(vectors) == 1 and not others else None


def _define(symbol: Callable[..., Any], emit: _Emit, *, compares: bool = False) -> None:
    """An operator between vectors, or a vector and a number."""

    @infer_global(symbol)
    class _Operator(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            vector = _vector_of(args) if len(args) == 2 else None
            if vector is not None:
                return signature(Mask(vector.lanes) if compares else vector, *args)
            return None

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        vector = _vector_of(sig.args)
        assert vector is not None
        operands = (
            _in_all_lanes(context, builder, v, kind, vector) for v, kind in zip(values, sig.args, strict=True)
        )
        return emit(builder, *operands)

    for kinds in ((Vector, Vector), (Vector, types.Number), (types.Number, Vector)):
        lower_builtin(symbol, *kinds)(generate)


def minimum(a: Any, b: Any) -> Any:
    """The smaller of each lane; b where one is NaN."""
    return np.where(a < b, a, b)


def maximum(a: Any, b: Any) -> Any:
    """The larger of each lane; b where one is NaN."""
    return np.where(a > b, a, b)


for _symbol in (operator.add, operator.iadd):
    _define(_symbol, lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
_define(operator.sub, lambda builder, a, b: builder.fsub(a, b, flags=_FLAGS))
_define(operator.mul, lambda builder, a, b: builder.fmul(a, b, flags=_FLAGS))
_define(operator.truediv, lambda builder, a, b: builder.fdiv(a, b, flags=_FLAGS))
_define(minimum, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
_define(maximum, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
for _symbol, _name in ((operator.ge, ">="), (operator.gt, ">"), (operator.le, "<="), (operator.lt, "<")):
    _define(_symbol, lambda builder, a, b, name=_name: builder.fcmp_ordered(name, a, b), compares=True)


def _define_alike(symbol: Callable[..., Any], *kinds: type, emit: Callable[..., Any]) -> None:
    """An operator whose operands are all of one type, which is the result's."""

    @infer_global(symbol)
    class _Operator(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            fits = len(args) == len(kinds) and isinstance(args[0], kinds) and len(set(args)) == 1
            return signature(args[0], *args) if fits else None

    lower_builtin(symbol, *kinds)(lambda context, builder, sig, values: emit(builder, *values))


_define_alike(operator.neg, Vector, emit=lambda builder, a: builder.fneg(a))
_define_alike(operator.and_, Mask, Mask, emit=lambda builder, a, b: builder.and_(a, b))


# Functions -----------------------------------------------------------------------------------------------


@intrinsic
def where(typing_context, mask, a, b):  # type: ignore[no-untyped-def]
    """a where the mask is set, b elsewhere; one of them may be a number."""
    vector = _vector_of((a, b))
    if vector is None or mask != Mask(vector.lanes):
        return None

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        lanes: Any = vector
        chosen = (_in_all_lanes(context, builder, values[k], sig.args[k], lanes) for k in (1, 2))
        return builder.select(values[0], *chosen)

    return vector(mask, a, b), generate


@intrinsic
def count(typing_context, mask):  # type: ignore[no-untyped-def]
    """How many lanes of a mask are set."""

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        bits = builder.bitcast(values[0], ir.IntType(mask.lanes))
        return builder.ctpop(builder.zext(bits, ir.IntType(64)))

    return types.int64(mask), generate


def _function(emit: Callable[..., Any], result: Callable[[Vector], types.Type] = lambda v: v) -> Any:
    @intrinsic
    def apply(typing_context: Any, a: Any) -> Any:
        if not isinstance(a, Vector):
            return None
        return result(a)(a), lambda context, builder, sig, values: emit(builder, a, values[0])

    return apply


def _polynomial(builder: Any, kind: Vector, x: Any, terms: list[Any]) -> Any:
    """Estrin's scheme, which has half the latency of Horner's."""
    while len(terms) > 3:
        pairs = zip(terms[::2], terms[1::2], strict=False)
        terms = [_fma(builder, kind, high, x, low) for low, high in pairs] + terms[len(terms) & ~1 :]
        x = builder.fmul(x, x)
    value = terms.pop()
    while terms:
        value = _fma(builder, kind, value, x, terms.pop())
    return value


def _exp2(builder: Any, kind: Vector, q: Any) -> Any:
    """Adding the shifter rounds to an integer, which then stands in the sum's low bits."""
    mantissa, coefficients = (23, _EXP2_SINGLE) if kind.element is types.float32 else (52, _EXP2_DOUBLE)
    shifter = kind.constant(1.5 * 2.0**mantissa)
    shifted = builder.fadd(q, shifter)
    f = builder.fsub(q, builder.fsub(shifted, shifter))
    power = _polynomial(builder, kind, f, [kind.constant(c) for c in coefficients])
    whole = builder.shl(builder.bitcast(shifted, kind.integers), kind.integer(mantissa))
    return builder.bitcast(builder.add(builder.bitcast(power, kind.integers), whole), kind.llvm)


def _log2(builder: Any, kind: Vector, x: Any) -> Any:
    """x = 2^e m with m around 1, then the series of atanh."""
    bits = builder.bitcast(x, kind.integers)
    above = builder.sub(bits, kind.integer(int(np.float64(math.sqrt(0.5)).view(np.int64))))
    exponent = builder.ashr(above, kind.integer(52))
    m = builder.bitcast(builder.sub(bits, builder.shl(exponent, kind.integer(52))), kind.llvm)
    one = kind.constant(1.0)
    s = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one))
    terms = [kind.constant(2 * math.log2(math.e) / odd) for odd in range(1, 13, 2)]
    series = _polynomial(builder, kind, builder.fmul(s, s), terms)
    return _fma(builder, kind, s, series, builder.sitofp(exponent, kind.llvm))


def _fma(builder: Any, kind: Vector, a: Any, b: Any, c: Any) -> Any:
    return _call(builder, f"llvm.fma.{kind.code}", kind.llvm, a, b, c)


# 2^f on [-1/2, 1/2], minimax in relative error: 2e-9 and 4e-11
_EXP2_SINGLE = (
    1.0000000005541685, 0.6931472057372559, 0.24022646890608662, 0.055503287769847295, 0.009618488959874036,
    0.0013399931212782282, 0.00015345811256863538,
)  # fmt: skip
_EXP2_DOUBLE = (
    0.9999999999616819, 0.6931471807284458, 0.24022651198157957, 0.05550410353450404, 0.009618027253635374,
    0.0013333922562072241, 0.0001546929114955514, 1.5201921878399555e-05,
)  # fmt: skip

exp2 = _function(_exp2)  # for |q| < 126, d8: 1000; beyond, any value
log2 = _function(_log2)  # of a positive d8, to 1e-10
sqrt = _function(lambda builder, kind, a: _call(builder, f"llvm.sqrt.{kind.code}", kind.llvm, a))
floor = _function(lambda builder, kind, a: _call(builder, f"llvm.floor.{kind.code}", kind.llvm, a))
ceil = _function(lambda builder, kind, a: _call(builder, f"llvm.ceil.{kind.code}", kind.llvm, a))
total = _function(
    lambda builder, kind, a: _call(
        builder, f"llvm.vector.reduce.fadd.{kind.code}", kind.llvm.element,
        ir.Constant(kind.llvm.element, -0.0), a, fastmath=("reassoc",),
    ),
    lambda kind: kind.element,
)  # fmt: skip
largest = _function(
    lambda builder, kind, a: _call(
        builder, f"llvm.vector.reduce.fmax.{kind.code}", kind.llvm.element, a, fastmath=("nnan",)
    ),
    lambda kind: kind.element,
)
double = _function(lambda builder, kind, a: builder.fpext(a, d8.llvm), lambda kind: d8)  # of an f8
single = _function(lambda builder, kind, a: builder.fptrunc(a, f8.llvm), lambda kind: f8)  # of a d8


@intrinsic
def fma(typing_context, a, b, c):  # type: ignore[no-untyped-def]
    """a b + c of three vectors, rounded once."""
    return a(a, b, c), lambda context, builder, sig, values: _fma(builder, a, *values)


def _splat(vector: Vector) -> Any:
    @intrinsic
    def splat(typing_context: Any, value: Any) -> Any:
        return vector(value), lambda context, builder, sig, values: _in_all_lanes(
            context, builder, values[0], value, vector
        )

    return splat


splat16, splat8 = _splat(f16), _splat(f8)  # a number in all lanes


# Memory --------------------------------------------------------------------------------------------------


def _address(
    context: Any,
    builder: Any,
    array: types.Array,
    value: Any,
    index: Any,
    kind: Any = None,
) -> Any:
    """Pointer to an element of a flat array, or to an LLVM value of another kind that begins there."""
    pointer = builder.gep(context.make_array(array)(context, builder, value).data, [index])
    return pointer if kind is None else builder.bitcast(pointer, kind.as_pointer())


def _reader(vector: Vector, read: Callable[..., Any]) -> Any:
    @intrinsic
    def load(typing_context: Any, array: Any, index: Any) -> Any:
        return vector(array, types.int64), lambda context, builder, sig, values: read(
            context, builder, vector, array, *values
        )

    return load


def _load(context: Any, builder: Any, vector: Vector, array: Any, data: Any, index: Any) -> Any:
    return builder.load(_address(context, builder, array, data, index, vector.llvm), align=4, typ=vector.llvm)


def _spread(context: Any, builder: Any, vector: Vector, array: Any, *values: Any) -> Any:
    one = builder.load(_address(context, builder, array, *values), typ=vector.llvm.element)
    return _repeat(builder, one, vector.lanes)


load16, load8 = _reader(f16, _load), _reader(f8, _load)  # array[index : index + lanes]
spread16, spread8 = _reader(f16, _spread), _reader(f8, _spread)  # array[index] in all lanes
load, spread, splat = (load16, spread16, splat16) if LANES == 16 else (load8, spread8, splat8)


def _channel_reader(channel: int) -> Any:
    def read(context: Any, builder: Any, vector: Vector, array: Any, data: Any, index: Any) -> Any:
        address = _address(context, builder, array, data, index)
        blocks = []
        for k in range(3):
            part = builder.gep(address, [ir.Constant(ir.IntType(64), 16 * k)])
            block = builder.bitcast(part, vector.llvm.as_pointer())
            blocks.append(builder.load(block, align=4, typ=vector.llvm))
        wanted = [3 * lane + channel for lane in range(16)]
        kind = ir.VectorType(_INT, 16)
        first = builder.shuffle_vector(*blocks[:2], ir.Constant(kind, [min(i, 31) for i in wanted]))
        rest = [lane if i < 32 else i - 16 for lane, i in enumerate(wanted)]
        return builder.shuffle_vector(first, blocks[2], ir.Constant(kind, rest))

    return _reader(f16, read)


# one channel of 16 pixels [16, 3] that begin at array[index]
load_red, load_green, load_blue = _channel_reader(0), _channel_reader(1), _channel_reader(2)


@intrinsic
def store(typing_context, array, index, vector):  # type: ignore[no-untyped-def]
    """array[index : index + lanes] = vector."""

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        builder.store(
            values[2], _address(context, builder, array, values[0], values[1], vector.llvm), align=4
        )
        return context.get_dummy_value()

    return types.void(array, types.int64, vector), generate


@intrinsic
def prefetch(typing_context, array, index):  # type: ignore[no-untyped-def]
    """Fetch array[index] into the cache: a later access need not wait for it."""

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        address = _address(context, builder, array, *values)
        address = builder.bitcast(address, ir.IntType(8).as_pointer())
        options = [ir.Constant(_INT, option) for option in (0, 3, 1)]  # to read, to keep, data
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), address, *options)
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@intrinsic
def gather(typing_context, array, index, stride):  # type: ignore[no-untyped-def]
    """array[index], array[index + stride], ... as an f8."""

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        address, vector = _address(context, builder, array, *values[:2]), ir.Constant(f8.llvm, ir.Undefined)
        for lane in range(f8.lanes):
            one = builder.load(address, typ=f8.llvm.element)
            vector = builder.insert_element(vector, one, ir.Constant(_INT, lane))
            address = builder.gep(address, [values[2]])
        return vector

    return f8(array, types.int64, types.int64), generate


@intrinsic
def scatter(typing_context, array, index, stride, vector):  # type: ignore[no-untyped-def]
    """array[index], array[index + stride], ... = an f8."""

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        address = _address(context, builder, array, *values[:2])
        for lane in range(f8.lanes):
            builder.store(builder.extract_element(values[3], ir.Constant(_INT, lane)), address)
            address = builder.gep(address, [values[2]])
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, vector), generate


def _folded(builder: Any, a: Any, b: Any, group: int) -> Any:
    """Lanes in groups: each half of a group of a, then of b, added to the group's other half."""
    lanes = a.type.count
    starts = [v + g for v in (0, lanes) for g in range(0, lanes, group)]
    orders = [[s + shift + i for s in starts for i in range(group // 2)] for shift in (0, group // 2)]
    kind = ir.VectorType(_INT, lanes)
    parts = (builder.shuffle_vector(a, b, ir.Constant(kind, order)) for order in orders)
    return builder.fadd(*parts, flags=_FLAGS)


@intrinsic
def store_totals(typing_context, array, index, v0, v1, v2, v3, v4, v5, v6, v7):  # type: ignore[no-untyped-def]
    """array[index : index + 8] = the sums of the lanes of eight f16 or eight f8, added as one tree."""
    if v0 not in (f16, f8):
        return None

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        vectors, group = list(values[2:]), v0.lanes
        while len(vectors) > 1:
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [_folded(builder, *pair, group) for pair in pairs]
            group //= 2
        sums = vectors[0]
        if group > 1:  # of f16 two lanes each are left
            none = ir.Constant(f16.llvm, ir.Undefined)
            orders = (
                ir.Constant(ir.VectorType(_INT, 8), [2 * k + shift for k in range(8)]) for shift in (0, 1)
            )
            parts = (builder.shuffle_vector(sums, none, order) for order in orders)
            sums = builder.fadd(*parts, flags=_FLAGS)
        address = _address(context, builder, array, values[0], values[1], f8.llvm)
        builder.store(sums, address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, *[v0] * 8), generate
