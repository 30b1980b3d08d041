"""Elementary functions on lanes: sine, cosine, exponential, arctangent without leaving the vector.

The C library knows one number at a time; a robot's model is half trigonometry. Reduction to a small
interval in three pieces of pi/2 (Cody, Waite 1980), then a polynomial: fdlibm's for sine and cosine
(Sun, 1993), Taylor's for the exponential, one of our own for the arctangent.
Good to about one unit in the last place while |x| < 1e6, which unwrapped angles are. The rest goes
to the C library lane by lane.
"""

from __future__ import annotations

import math

from grounded.compile.emit.llvm_text import Writer, splat, vector

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
ATAN = (  # (atan(x) / x - 1) / x^2 in x^2, interpolated at Chebyshev's points up to tan(pi / 8)
    -0.3333333333333333,
    0.19999999999995519,
    -0.14285714284666234,
    0.11111111015231484,
    -0.09090904577092156,
    0.07692183166364956,
    -0.06664511096795875,
    0.05858145823777143,
    -0.05085433387030355,
    0.039231181543784695,
    -0.019176298874366237,
)

ASIN = (  # (asin(x) / x - 1) / x^2 in x^2, likewise up to x = 1/2
    0.16666666666666669,
    0.07499999999998433,
    0.04464285714635544,
    0.03038194413853449,
    0.022372172941915732,
    0.017352392727934783,
    0.013971212851918104,
    0.011479178733064088,
    0.010322805051652312,
    0.005457549375313392,
    0.01740075682113532,
    -0.014851686572448643,
    0.028757709154150685,
)


class Lanes:
    """Elementary functions of W lanes, written with a Writer."""

    def __init__(self, f: Writer, width: int) -> None:
        self.f, self.width = f, width
        self.whole = "i64" if width == 1 else f"<{width} x i64>"  # W integers
        self.angles: dict[str, tuple[str, str]] = {}

    def const(self, value: float) -> str:
        """A constant in every lane."""
        return splat(value, self.width)

    def polynomial(self, x: str, coefficients: tuple[float, ...]) -> str:
        """c0 + c1 x + c2 x^2 ... by Estrin's scheme, which shortens the chain of dependences."""
        f, w = self.f, self.width
        terms = [self.const(c) for c in coefficients]
        while len(terms) > 1:
            terms = [
                f.fma(x, terms[i + 1], terms[i], w) if i + 1 < len(terms) else terms[i]
                for i in range(0, len(terms), 2)
            ]
            if len(terms) > 1:
                x = f.mul(x, x, w)
        return terms[0]

    def _bits(self, value: str) -> str:
        return self.f.emit(f"bitcast {vector(self.width)} {value} to {self.whole}")

    def _from_bits(self, value: str) -> str:
        return self.f.emit(f"bitcast {self.whole} {value} to {vector(self.width)}")

    def _bitwise(self, op: str, a: str, value: int) -> str:
        inside = ", ".join(f"i64 {value}" for _ in range(self.width))
        return self.f.emit(f"{op} {self.whole} {a}, {value if self.width == 1 else f'<{inside}>'}")

    def _exclusive(self, a: str, b: str) -> str:
        return self.f.emit(f"xor {self.whole} {a}, {b}")

    def _is_set(self, bit: str) -> str:
        zero = "0" if self.width == 1 else "zeroinitializer"
        return self.f.emit(f"icmp ne {self.whole} {bit}, {zero}")

    def _rounding(self, x: str, scale: float) -> str:
        """MAGIC + the integer nearest to scale x; taking MAGIC off leaves the integer."""
        return self.f.fma(x, self.const(scale), self.const(MAGIC), self.width)

    def sincos(self, x: str) -> tuple[str, str]:
        """Sine and cosine, one reduction for both."""
        if x not in self.angles:
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
            self.angles[x] = self._quadrant(shifted, sine, cosine)
        return self.angles[x]

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
        bits = "i1" if w == 1 else f"<{w} x i1>"
        beyond = f.select(high, self.const(math.inf), self.const(0.0), w)
        return f.select(f.emit(f"or {bits} {low}, {high}"), beyond, self.exp_within(x), w)

    def exp_within(self, x: str) -> str:
        """e^x for x in [-708, 709.78]."""
        f, w = self.f, self.width
        shifted = self._rounding(x, 1 / math.log(2))
        n = f.emit(f"fsub {vector(w)} {shifted}, {self.const(MAGIC)}")
        r = f.sub(x, f.mul(n, self.const(LN2[0]), w), w)
        r = f.sub(r, f.mul(n, self.const(LN2[1]), w), w)
        start = f.add(r, self.const(1.0), w)
        mantissa = f.fma(f.mul(r, r, w), self.polynomial(r, EXP), start, w)
        exponent = self._bitwise("shl", self._bits(shifted), 52)
        return self._from_bits(f.emit(f"add {self.whole} {self._bits(mantissa)}, {exponent}"))

    def tanh(self, x: str) -> str:
        """(1 - e) / (1 + e) with e = exp(-2 |x|), and x's sign."""
        f, w = self.f, self.width
        e = self.exp(f.mul(f.call("fabs", [x], w), self.const(-2.0), w))
        one = self.const(1.0)
        size = f.div(f.sub(one, e, w), f.add(one, e, w), w)
        return f.select(f.compare("olt", x, self.const(0.0), w), f.neg(size, w), size, w)

    def atan2(self, y: str, x: str) -> str:
        """The angle of (x, y) in (-pi, pi]; if it is small in all lanes, without the rest."""
        f, w = self.f, self.width
        size = f.call("fabs", [y], w)
        (angle,) = f.either(
            f.all(f.compare("olt", size, self._eighth(x), w), w),
            lambda: [self._arctangent(f.div(y, x, w))],
            lambda: [self._any_angle(y, x)],
            w,
        )
        return angle

    def _any_angle(self, y: str, x: str) -> str:
        f, w = self.f, self.width
        ax, ay = f.call("fabs", [x], w), f.call("fabs", [y], w)
        steep = f.compare("ogt", ay, ax, w)
        left = self._is_set(self._bitwise("lshr", self._bits(x), 63))
        far = self._both(self._beyond_eighth(ay, ax), self._beyond_eighth(ax, ay))
        core = self._small_angle(ay, ax, steep, far)
        base, turn = self._octant(far, steep, left)
        angle = f.fma(turn, core, base, w)
        signed = self._bitwise("and", self._bits(y), -(1 << 63))
        return self._from_bits(self._exclusive(self._bits(angle), signed))

    def _both(self, a: str, b: str) -> str:
        bits = "i1" if self.width == 1 else f"<{self.width} x i1>"
        return self.f.emit(f"and {bits} {a}, {b}")

    def _beyond_eighth(self, y: str, x: str) -> str:
        """Whether y / x is above tan(pi / 8)."""
        return self.f.compare("ogt", y, self._eighth(x), self.width)

    def _eighth(self, x: str) -> str:
        """The y at which the angle of (x, y) is pi / 8."""
        return self.f.mul(x, self.const(math.tan(math.pi / 8)), self.width)

    def _small_angle(self, y: str, x: str, steep: str, far: str) -> str:
        """The angle of (x, y) to the nearer axis, less pi/4 if it is far from it; one division.

        x and y >= 0. What is divided in each case is there before it is known which case it is.
        """
        f, w, total = self.f, self.width, self.f.add(x, y, self.width)
        nowhere = f.compare("oeq", total, self.const(0.0), w)
        less = f.neg(f.call("fabs", [f.sub(y, x, w)], w), w)
        small, large = f.select(steep, x, y, w), f.select(steep, y, x, w)
        large = f.select(nowhere, self.const(1.0), large, w)
        t = f.div(f.select(far, less, small, w), f.select(far, total, large, w), w)
        return self._arctangent(t)

    def _arctangent(self, t: str) -> str:
        """The arctangent of t in [-tan(pi / 8), tan(pi / 8)]."""
        f, w = self.f, self.width
        z = f.mul(t, t, w)
        return f.fma(f.mul(t, z, w), self.polynomial(z, ATAN), t, w)

    def _octant(self, far: str, steep: str, left: str) -> tuple[str, str]:
        """(base, turn): the whole angle is base + turn * small angle."""
        f, w = self.f, self.width
        zero, half, whole = (self.const(v * math.pi) for v in (0.0, 0.5, 1.0))
        base = f.select(far, self.const(math.pi / 4), zero, w)
        base = f.select(steep, f.sub(half, base, w), base, w)
        base = f.select(left, f.sub(whole, base, w), base, w)
        one, back = self.const(1.0), self.const(-1.0)
        flipped = f.select(steep, f.select(left, one, back, w), f.select(left, back, one, w), w)
        return base, flipped

    def asin(self, x: str) -> str:
        """The arcsine, NaN outside [-1, 1]; beyond 1/2 by the root of half of what is left to 1."""
        f, w = self.f, self.width
        small = f.compare("ole", f.call("fabs", [x], w), self.const(0.5), w)
        (angle,) = f.either(
            f.all(small, w),
            lambda: [self._arcsine(x, f.mul(x, x, w))],
            lambda: [self._any_arcsine(x)],
            w,
        )
        return angle

    def _arcsine(self, x: str, z: str) -> str:
        """The arcsine of x in [-1/2, 1/2], z its square."""
        f, w = self.f, self.width
        return f.fma(f.mul(z, self.polynomial(z, ASIN), w), x, x, w)

    def _any_arcsine(self, x: str) -> str:
        f, w = self.f, self.width
        size, half = f.call("fabs", [x], w), self.const(0.5)
        large = f.compare("ogt", size, half, w)
        rest = f.fma(size, self.const(-0.5), half, w)
        z = f.select(large, rest, f.mul(x, x, w), w)
        base = f.select(large, f.call("sqrt", [rest], w), size, w)
        angle = self._arcsine(base, z)
        folded = f.fma(angle, self.const(-2.0), self.const(math.pi / 2), w)
        angle = f.select(large, folded, angle, w)
        sign = self._bitwise("and", self._bits(x), -(1 << 63))
        return self._from_bits(self._exclusive(self._bits(angle), sign))

    def acos(self, x: str) -> str:
        """The arccosine, NaN outside [-1, 1]."""
        return self.f.sub(self.const(math.pi / 2), self.asin(x), self.width)

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
