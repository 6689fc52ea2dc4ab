"""Rules for the numbers of a result, each a function of the Dataset alone. NaN obeys every rule."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from drivetrain_jax._wording import shown

# Relative tolerance for the rounding of a formula evaluated in another order.
ROUNDING = 1e-9


@dataclass(frozen=True)
class Rule:
    """A rule with its ``text``: ``broken(dataset)`` is true where it is broken, and needs all of ``variables``."""

    text: str
    variables: tuple[str, ...]
    broken: Callable[[xr.Dataset], xr.DataArray]

    def __post_init__(self) -> None:
        if isinstance(self.variables, str):
            raise TypeError(f"variables = {self.variables!r}: allowed is a tuple of names, ({self.variables!r},)")


def within(name: str, lower: float = -np.inf, upper: float = np.inf) -> Rule:
    """``lower <= name <= upper`` up to rounding."""
    bounds = [f"{lower:g} <= " if lower > -np.inf else "", f" <= {upper:g}" if upper < np.inf else ""]
    room = ROUNDING * max(abs(x) for x in (lower, upper, 0.0) if np.isfinite(x))
    return Rule(
        f"{bounds[0]}{name}{bounds[1]}", (name,), lambda ds: (ds[name] < lower - room) | (ds[name] > upper + room)
    )


def ordered(name: str, dim: str, falling: bool = False, key: Callable = lambda values: values) -> Rule:
    """``name`` rises (or falls) along ``dim`` up to rounding; ``key`` computes the compared quantity."""

    def broken(ds: xr.Dataset) -> xr.DataArray:
        step = key(ds[name]).diff(dim)
        room = ROUNDING * abs(key(ds[name])).max(dim)
        return step > room if falling else step < -room

    return Rule(f"{name} {'falls' if falling else 'rises'} along {dim}", (name,), broken)


def sums_to_one(name: str, dim: str, others: tuple[str, ...] = ()) -> Rule:
    """``name`` summed over ``dim``, plus ``others``, is 1 where there is a value."""

    def broken(ds: xr.Dataset) -> xr.DataArray:
        total = ds[name].sum(dim) + sum(ds[other] for other in others)
        return (abs(total - 1) > ROUNDING) & ds[name].notnull().any(dim)

    return Rule(" + ".join((f"sum of {name} over {dim}", *others)) + " = 1", (name, *others), broken)


def in_order(*names: str) -> Rule:
    """Each of ``names`` is at most the next."""

    def broken(ds: xr.Dataset) -> xr.DataArray:
        size = sum(abs(ds[name]) for name in names)
        pairs = [ds[a] > ds[b] + ROUNDING * size for a, b in itertools.pairwise(names)]
        return xr.concat(pairs, "pair").any("pair")

    return Rule(" <= ".join(names), names, broken)


def relation(text: str, variables: tuple[str, ...], broken: Callable[[xr.Dataset], xr.DataArray]) -> Rule:
    """A rule given by its text and function."""
    return Rule(text, variables, broken)


def multiple(name: str, factor: float, of: str) -> Rule:
    """``name = factor * of``."""
    return Rule(f"{name} = {factor:.6g} {of}", (name, of), lambda ds: _differ(ds[name], factor * ds[of]))


def _differ(one: xr.DataArray, other: xr.DataArray) -> xr.DataArray:
    return abs(one - other) > ROUNDING * (abs(one) + abs(other))


@dataclass(frozen=True)
class Declared:
    """``rules`` of an analysis. ``gaps``: variables that may be NaN after a success; ``kept``: variables that may have a
    value after a failure.

    ``has_points`` is false for a function of the parameters, which has no outcomes.
    """

    rules: tuple[Rule, ...] = ()
    gaps: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    has_points: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.rules, tuple) or not all(isinstance(rule, Rule) for rule in self.rules):
            raise TypeError(f"rules: got {shown(self.rules)}; allowed is a tuple of rules, (rule, ...)")
