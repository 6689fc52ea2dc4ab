"""Rules for results of the analysis ``floquet``."""

from __future__ import annotations

from collections.abc import Callable

import xarray as xr

from drivetrain_jax._rules import Declared, ordered, relation, within

# Error of a radius that is known to be 1: four roundings.
_ROUNDING = 1e-15


def _all_multipliers(compare: Callable[[xr.DataArray, xr.Dataset], xr.DataArray]) -> Callable:
    return lambda ds: compare(abs(ds["floquet_multiplier"]).max("multiplier"), ds)


def _liouville(ds: xr.Dataset) -> xr.DataArray:
    """True where the residual contradicts the bound: a coefficient's error e moves the largest of n roots by e/2^n."""
    # If the multipliers are not stored, n is four as for cardan. A larger n misses errors, a smaller n reports false ones.
    n = ds.sizes.get("multiplier", 4)
    wrong = abs(ds["liouville_residual"]) > 2**n * ds["spectral_radius_error"] / ds["spectral_radius"]
    return wrong & ~_is_one(ds)


def _is_one(ds: xr.Dataset) -> xr.DataArray:
    """True where the radius is known to be 1: without damping, if all multipliers are simple and on the unit circle."""
    rho, error = ds["spectral_radius"], ds["spectral_radius_error"]
    return (error <= _ROUNDING) & (abs(rho - 1) <= error)


def _verdict(ds: xr.Dataset) -> xr.DataArray:
    """0 stable, 1 unstable, 2 undecided, from the interval of the spectral radius.

    Where the radius is 1, stable means bounded. Without damping an atlas also knows it to exceed 1 within its interval.
    """
    rho, error, verdict = ds["spectral_radius"], ds["spectral_radius_error"], ds["verdict"]
    stable, unstable = (rho + error < 1) | _is_one(ds), rho - error > 1
    return (stable != (verdict == 0)) | (unstable & (verdict != 1)) | ((rho + error <= 1) & (verdict == 1))


RULES = Declared(
    (
        ordered("floquet_multiplier", "multiplier", falling=True, key=abs),
        relation(
            "spectral_radius is the largest modulus of floquet_multiplier",
            ("spectral_radius", "floquet_multiplier"),
            _all_multipliers(lambda top, ds: abs(top - ds["spectral_radius"]) > 1e-9 * top),
        ),
        relation(
            "verdict follows from spectral_radius and its bound",
            ("verdict", "spectral_radius", "spectral_radius_error"),
            _verdict,
        ),
        relation(
            "liouville_residual lies within the bound of spectral_radius",
            ("liouville_residual", "spectral_radius", "spectral_radius_error"),
            _liouville,
        ),
        within("spectral_radius", 0.0),
    ),
)
