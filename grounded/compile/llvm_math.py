"""Elementary functions on lanes: sine, cosine, exponential, arctangent without leaving the vector.

The C library knows one number at a time; a robot's model is half trigonometry. Reduction to a small
interval in three pieces of pi/2 (Cody, Waite 1980), then the polynomials of fdlibm (Sun, 1993) for
sine, cosine, exponential, and the rational function of Cephes (Moshier, 1989) for the arctangent.
Good to about one unit in the last place while |x| < 1e6, which unwrapped angles are. The rest goes
to the C library lane by lane.
"""

from __future__ import annotations

import math

from grounded.compile.llvm_text import Writer, number, splat, vector

SIN = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
COS = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)
HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
EXP = tuple(1.0 / math.factorial(i) for i in range(2, 14))
LN2 = (6.93147180369123816490e-01, 1.90821492927058770002e-10)
MAGIC = 6755399441055744.0  # 1.5 2^52: adding it rounds, and leaves the integer in the low bits
ATAN_P = (
    -8.750608600031904122785e-01,
    -1.615753718733365076637e01,
    -7.500855792314704667340e01,
    -1.228866684490136173410e02,
    -6.485021904942025371773e01,
)
ATAN_Q = (
    1.0,
    2.485846490142306297962e01,
    1.650270098316988542046e02,
    4.328810604912902668951e02,
    4.853903996359136964868e02,
    1.945506571482613964425e02,
)


class Lanes:
    """Elementary functions of W lanes, written with a Writer."""

    def __init__(self, f: Writer, width: int) -> None:
        self.f, self.width = f, width
        self._angles: dict[str, tuple[str, str]] = {}

    def const(self, value: float) -> str:
        """A constant in every lane."""
        return splat(value, self.width)

    def polynomial(self, x: str, coefficients: tuple[float, ...]) -> str:
        """c0 + c1 x + c2 x^2 ... by Estrin's scheme, which shortens the chain of dependences."""
        f, w = self.f, self.width
        terms = [self.const(c) for c in coefficients]
        while len(terms) > 1:
            pairs = [
                f.fma(x, terms[i + 1], terms[i], w) if i + 1 < len(terms) else terms[i]
                for i in range(0, len(terms), 2)
            ]
            terms = pairs
            if len(terms) > 1:
                x = f.mul(x, x, w)
        return terms[0]

    def _bits(self, value: str) -> str:
        kind = "i64" if self.width == 1 else f"<{self.width} x i64>"
        return self.f.emit(f"bitcast {vector(self.width)} {value} to {kind}")

    def _from_bits(self, value: str) -> str:
        kind = "i64" if self.width == 1 else f"<{self.width} x i64>"
        return self.f.emit(f"bitcast {kind} {value} to {vector(self.width)}")

    def _bitwise(self, op: str, a: str, value: int) -> str:
        if self.width == 1:
            return self.f.emit(f"{op} i64 {a}, {value}")
        inside = ", ".join(f"i64 {value}" for _ in range(self.width))
        return self.f.emit(f"{op} <{self.width} x i64> {a}, <{inside}>")

    def _exclusive(self, a: str, b: str) -> str:
        kind = "i64" if self.width == 1 else f"<{self.width} x i64>"
        return self.f.emit(f"xor {kind} {a}, {b}")

    def _is_set(self, bit: str) -> str:
        if self.width == 1:
            return self.f.emit(f"icmp ne i64 {bit}, 0")
        return self.f.emit(f"icmp ne <{self.width} x i64> {bit}, zeroinitializer")

    def _rounding(self, x: str, scale: float) -> str:
        """MAGIC + the integer nearest to scale x; not fused, so that MAGIC can be taken off."""
        kind = vector(self.width)
        scaled = self.f.emit(f"fmul {kind} {x}, {self.const(scale)}")
        return self.f.emit(f"fadd {kind} {scaled}, {self.const(MAGIC)}")

    def sincos(self, x: str) -> tuple[str, str]:
        """Sine and cosine, one reduction for both."""
        if x in self._angles:
            return self._angles[x]
        f, w = self.f, self.width
        shifted = self._rounding(x, 2 / math.pi)
        turns = f.emit(f"fsub {vector(w)} {shifted}, {self.const(MAGIC)}")
        r = x
        for part in HALF_PI:
            r = f.sub(r, f.mul(turns, self.const(part), w), w)
        z = f.mul(r, r, w)
        sine = f.fma(f.mul(z, r, w), self.polynomial(z, SIN), r, w)
        half = f.fma(z, self.const(-0.5), self.const(1.0), w)
        cosine = f.fma(f.mul(z, z, w), self.polynomial(z, COS), half, w)
        self._angles[x] = self._quadrant(shifted, sine, cosine)
        return self._angles[x]

    def _quadrant(self, shifted: str, sine: str, cosine: str) -> tuple[str, str]:
        f, w = self.f, self.width
        q = self._bits(shifted)
        odd = self._is_set(self._bitwise("and", q, 1))
        s, c = f.select(odd, cosine, sine, w), f.select(odd, sine, cosine, w)
        flip_s = self._bitwise("shl", self._bitwise("and", q, 2), 62)
        flip_c = self._bitwise("shl", self._bitwise("and", self._bitwise("add", q, 1), 2), 62)
        return (
            self._from_bits(self._exclusive(self._bits(s), flip_s)),
            self._from_bits(self._exclusive(self._bits(c), flip_c)),
        )

    def exp(self, x: str) -> str:
        """e^x: 0 below -708, infinite above 709.78, NaN for NaN."""
        f, w = self.f, self.width
        low = f.compare("olt", x, self.const(-708.0), w)
        high = f.compare("ogt", x, self.const(709.78), w)
        inside = f.select(low, self.const(0.0), f.select(high, self.const(0.0), x, w), w)
        scaled = f.select(high, self.const(math.inf), self.exp_within(inside), w)
        return f.select(low, self.const(0.0), scaled, w)

    def exp_within(self, x: str) -> str:
        """e^x for x in [-708, 709.78]."""
        f, w = self.f, self.width
        shifted = self._rounding(x, 1 / math.log(2))
        n = f.emit(f"fsub {vector(w)} {shifted}, {self.const(MAGIC)}")
        r = f.sub(x, f.mul(n, self.const(LN2[0]), w), w)
        r = f.sub(r, f.mul(n, self.const(LN2[1]), w), w)
        tail = f.fma(f.mul(r, r, w), self.polynomial(r, EXP), r, w)
        mantissa = f.add(tail, self.const(1.0), w)
        exponent = self._bitwise("shl", self._bits(shifted), 52)
        kind = "i64" if w == 1 else f"<{w} x i64>"
        return self._from_bits(f.emit(f"add {kind} {self._bits(mantissa)}, {exponent}"))

    def tanh(self, x: str) -> str:
        """(1 - e) / (1 + e) with e = exp(-2 |x|), and x's sign."""
        f, w = self.f, self.width
        e = self.exp(f.mul(f.call("fabs", [x], w), self.const(-2.0), w))
        one = self.const(1.0)
        size = f.div(f.sub(one, e, w), f.add(one, e, w), w)
        return f.select(f.compare("olt", x, self.const(0.0), w), f.neg(size, w), size, w)

    def atan2(self, y: str, x: str) -> str:
        """The angle of (x, y) in (-pi, pi]."""
        f, w = self.f, self.width
        zero = self.const(0.0)
        ax, ay = f.call("fabs", [x], w), f.call("fabs", [y], w)
        steep = f.compare("ogt", ay, ax, w)
        small, large = f.select(steep, ax, ay, w), f.select(steep, ay, ax, w)
        both_zero = f.compare("oeq", large, zero, w)
        ratio = f.div(small, f.select(both_zero, self.const(1.0), large, w), w)
        angle = self._atan_unit(ratio)
        angle = f.select(steep, f.sub(self.const(math.pi / 2), angle, w), angle, w)
        left = self._is_set(self._bitwise("lshr", self._bits(x), 63))
        angle = f.select(left, f.sub(self.const(math.pi), angle, w), angle, w)
        signed = self._bitwise("and", self._bits(y), -(1 << 63))
        return self._from_bits(self._exclusive(self._bits(angle), signed))

    def _atan_unit(self, t: str) -> str:
        """The arctangent of 0 <= t <= 1: about 0 or about 1."""
        f, w = self.f, self.width
        far = f.compare("ogt", t, self.const(0.66), w)
        one = self.const(1.0)
        moved = f.div(f.sub(t, one, w), f.add(t, one, w), w)
        x = f.select(far, moved, t, w)
        z = f.mul(x, x, w)
        p = self.polynomial(z, ATAN_P[::-1])
        q = self.polynomial(z, ATAN_Q[::-1])
        angle = f.fma(f.mul(x, z, w), f.div(p, q, w), x, w)
        return f.select(far, f.add(angle, self.const(math.pi / 4), w), angle, w)

    def asin(self, x: str) -> str:
        """The arcsine, NaN outside [-1, 1]."""
        f, w = self.f, self.width
        one = self.const(1.0)
        rest = f.mul(f.sub(one, x, w), f.add(one, x, w), w)
        return self.atan2(x, f.call("sqrt", [rest], w))

    def acos(self, x: str) -> str:
        """The arccosine, NaN outside [-1, 1]."""
        f, w = self.f, self.width
        one = self.const(1.0)
        rest = f.mul(f.sub(one, x, w), f.add(one, x, w), w)
        return self.atan2(f.call("sqrt", [rest], w), x)

    def library(self, name: str, *args: str) -> str:
        """A function of the C library, lane by lane."""
        f, w = self.f, self.width
        if w == 1:
            return f.emit(f"call double @{name}({', '.join(f'double {a}' for a in args)})")
        result = "poison"
        for i in range(w):
            inside = ", ".join(f"double {f.lane(a, i, w)}" for a in args)
            one = f.emit(f"call double @{name}({inside})")
            result = f.emit(f"insertelement {vector(w)} {result}, double {one}, i64 {i}")
        return result


__all__ = ["Lanes", "number"]
