"""Planck's law within a band in as many digits as mpmath is set to, by another way than the product's: series of tails."""

import mpmath


def constants():
    """2 h c² in W m²/sr and h c/k in m K."""
    h, c, k = mpmath.mpf("6.62607015e-34"), mpmath.mpf(299792458), mpmath.mpf("1.380649e-23")
    return 2 * h * c**2, h * c / k


def _tail(x):
    """∫_x^∞ u³/(e^u - 1) du, the sum of the tails of u³ e^{-nu}."""
    terms = int(mpmath.mp.dps * 2.4 / x) + 3
    return mpmath.fsum(
        mpmath.exp(-n * x) * (x**3 / n + 3 * x**2 / n**2 + 6 * x / n**3 + mpmath.mpf(6) / n**4)
        for n in range(1, terms + 1)
    )


def _head(x):
    """∫_0^x u³/(e^u - 1) du for x below 2: the series of Bernoulli numbers, whose radius is 2 π."""
    orders = (0, 1, *range(2, 2 * mpmath.mp.dps + 4, 2))
    return mpmath.fsum(mpmath.bernoulli(n) / (mpmath.factorial(n) * (n + 3)) * x ** (n + 3) for n in orders)


def band_radiance(temperature_k, shortest_um="7.5", longest_um="14"):
    """Radiance of a black body in W/(m² sr)."""
    first, second = constants()
    low, high = (second * 10**6 / (mpmath.mpf(end) * temperature_k) for end in (longest_um, shortest_um))
    between = _head(high) - _head(low) if high < 2 else _tail(low) - _tail(high)
    return first * (temperature_k / second) ** 4 * between


def band_slope(temperature_k, shortest_um="7.5", longest_um="14"):
    """Its derivative by the temperature in W/(m² sr K): a central difference that keeps two thirds of the digits."""
    step = temperature_k * mpmath.mpf(10) ** (-mpmath.mp.dps // 3)
    after, before = (band_radiance(temperature_k + sign * step, shortest_um, longest_um) for sign in (1, -1))
    return (after - before) / (2 * step)
