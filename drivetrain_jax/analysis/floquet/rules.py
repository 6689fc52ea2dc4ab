"""Rules for results of the analysis ``floquet``."""

from __future__ import annotations

from collections.abc import Callable

import xarray as xr

from drivetrain_jax._rules import Declared, ordered, relation, within


def _all_multipliers(compare: Callable[[xr.DataArray, xr.Dataset], xr.DataArray]) -> Callable:
    return lambda ds: compare(abs(ds["floquet_multiplier"]).max("multiplier"), ds)


def _liouville(ds: xr.Dataset) -> xr.DataArray:
    """True where the residual contradicts the bound: a coefficient's error e moves the largest of n roots by e/2^n."""
    # If the multipliers are not stored, n is four as for cardan. A larger n misses errors, a smaller n reports false ones.
    n = ds.sizes.get("multiplier", 4)
    return abs(ds["liouville_residual"]) > 2**n * ds["spectral_radius_error"] / ds["spectral_radius"]


def _verdict(ds: xr.Dataset) -> xr.DataArray:
    """0 stable, 1 unstable, 2 undecided, from the interval of the spectral radius."""
    rho, error, verdict = ds["spectral_radius"], ds["spectral_radius_error"], ds["verdict"]
    return ((rho + error < 1) != (verdict == 0)) | ((rho - error > 1) != (verdict == 1))


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
