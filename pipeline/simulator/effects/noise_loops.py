"""The readout's loops, compiled: normal deviates out of random words, and what shot and read noise make raw numbers of.

Logarithm, sine and cosine are polynomials, so that all of a loop is done for many numbers at a time.
"""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from pipeline.compiled import DOUBLES, FLOATS, OFFSETS, compiled, rows_of

Light = NDArray[np.float32]
_AT_ONCE = 1024  # numbers that stay in the processor's first cache
_WORDS, _LIGHT, _RAW = rows_of(types.uint32, 1), rows_of(FLOATS, 1), rows_of(types.uint16, 1)
_ENDLESS = 0x7F800000  # bits of an infinite float32; of what is no number they are more


@compiled(_WORDS, OFFSETS, _LIGHT)
def draw_pairs(words: NDArray[np.uint32], piece: int, drawn: Light) -> None:
    """Write standard normal deviates, a piece after the other: of each, words for radii, then as many for turns.

    r = sqrt(-2 ln u) and a turn t give r cos t and r sin t. ln is that of 2^e m with m about 1: a polynomial of m - 1,
    right to 1e-7; so are sine and cosine within an eighth of a turn, and the quarter says which and with which sign.
    """
    radius, rest = np.empty(_AT_ONCE, np.float32), np.empty(_AT_ONCE, np.float32)
    bits = radius.view(np.int32)
    for first in range(0, len(drawn), piece):
        half = min(piece, len(drawn) - first) // 2
        for start in range(0, half, _AT_ONCE):
            some, at = min(_AT_ONCE, half - start), np.uint64(first + start)
            for n in range(some):
                radius[n] = np.float32(words[at + np.uint64(n)]) * np.float32(2**-32) + np.float32(2**-33)  # never 0
            for n in range(some):
                power = (bits[n] - np.int32(0x3F3504F3)) >> np.int32(23)  # m from sqrt(1/2) to sqrt(2)
                bits[n] -= power << np.int32(23)
                rest[n] = np.float32(power)
            for n in range(some):
                m = radius[n] - np.float32(1)
                p = np.float32(7.0376836292e-2) * m - np.float32(1.1514610310e-1)
                p = p * m + np.float32(1.1676998740e-1)
                p = p * m - np.float32(1.2420140846e-1)
                p = p * m + np.float32(1.4249322787e-1)
                p = p * m - np.float32(1.6668057665e-1)
                p = p * m + np.float32(2.0000714765e-1)
                p = p * m - np.float32(2.4999993993e-1)
                p = p * m + np.float32(3.3333331174e-1)
                log = m + (p * m - np.float32(0.5)) * (m * m) + rest[n] * np.float32(0.6931471805599453)
                radius[n] = np.sqrt(max(np.float32(-2) * log, np.float32(0)))
            for n in range(some):
                turn = np.int32(words[at + np.uint64(half + n)])
                quarter = (turn + np.int32(1 << 29)) >> np.int32(30)
                t = np.float32(turn - (quarter << np.int32(30))) * np.float32(np.pi * 2**-31)
                square = t * t
                s = np.float32(-1.9515295891e-4) * square + np.float32(8.3321608736e-3)
                s = (s * square - np.float32(1.6666654611e-1)) * square * t + t
                c = np.float32(2.443315711809948e-5) * square - np.float32(1.388731625493765e-3)
                c = (c * square + np.float32(4.166664568298827e-2)) * square * square
                c = c - np.float32(0.5) * square + np.float32(1)
                odd = quarter & np.int32(1)
                along, aside = (s, c) if odd else (c, s)
                along = -along if (quarter + odd) & np.int32(2) else along
                aside = -aside if quarter & np.int32(2) else aside
                drawn[at + np.uint64(n)] = along * radius[n]
                drawn[at + np.uint64(half + n)] = aside * radius[n]


@compiled(_LIGHT, _LIGHT, _LIGHT, DOUBLES, DOUBLES, DOUBLES, DOUBLES, _RAW)
def read_merged(
    light: Light,
    added: Light,
    deviate: Light,
    read_noise_e: float,
    electrons_per_dn: float,
    dark_dn: float,
    full_scale_dn: float,
    raw: NDArray[np.uint16],
) -> bool:
    """Write the numbers of light with shot and read noise of one deviate z; whether all that is expected was finite.

    The electrons are mean + sqrt(V) z + (k3 / 6 V) (z^2 - 1): three cumulants are right (Cornish and Fisher, 1938,
    second order); what is left is bounded by `noise.divergence`. ``light`` below 0 counts as 0; ``added`` comes to it,
    one number or as many as light. All [e-]. Numbers are rounded half to even, within 0 and full scale.
    """
    read, per_dn, dark, most = (
        np.float32(read_noise_e * read_noise_e),
        np.float32(electrons_per_dn),
        np.float32(dark_dn),
        np.float32(full_scale_dn),
    )
    expected = np.empty(_AT_ONCE, np.float32)
    bits = expected.view(np.int32)
    every, worst = np.uint64(1 if len(added) > 1 else 0), np.int32(0)
    for first in range(0, len(light), _AT_ONCE):
        some, start = min(_AT_ONCE, len(light) - first), np.uint64(first)
        if every:
            for n in range(some):
                one = light[start + np.uint64(n)]
                expected[n] = (np.float32(0) if one < 0 else one) + added[start + np.uint64(n)]
        else:
            for n in range(some):
                one = light[start + np.uint64(n)]
                expected[n] = (np.float32(0) if one < 0 else one) + added[0]
        for n in range(some):
            worst = max(worst, bits[n] & np.int32(0x7FFFFFFF))
        for n in range(some):
            mean, z = expected[n], deviate[start + np.uint64(n)]
            variance = mean + read
            skew = mean / variance * np.float32(1 / 6)
            electrons = (np.sqrt(variance) + skew * z) * z - skew + mean
            dn = electrons / per_dn + dark
            dn = dn if dn > 0 else np.float32(0)
            dn = dn if dn < most else most
            dn = (dn + np.float32(1 << 23)) - np.float32(1 << 23)  # half to even
            raw[start + np.uint64(n)] = np.uint16(np.int32(dn))
    return bool(worst < _ENDLESS)
