"""Masses joined by springs: the models of the analyses ``modes`` and ``harmonic_response``."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array


class Block(eqx.Module):
    """An invariant part of a spring system: its natural angular frequencies are the singular values of ``factor``.

    ``factor`` has shape (rows, n, ...), rows >= n. The orthonormal ``basis`` (dofs, n, copies, ...) embeds the part into the
    mass-weighted coordinates ``M^(1/2) q``; every frequency occurs ``copies`` times. ``family`` (n,) is the family of each
    column of the orthonormal ``frame`` (n, n, ...), which is None for the identity. ``polar`` (n,) marks columns that are
    motions along x, to make the vectors of a pair of equal frequencies unique.
    """

    factor: Array
    family: np.ndarray
    polar: np.ndarray
    basis: Array
    frame: Array | None = None

    @property
    def copies(self) -> int:
        """Multiplicity of each frequency."""
        return self.basis.shape[2]


class SpringSystem(eqx.Module):
    """``M q'' + B^T diag(k) B q = 0`` with the diagonal mass matrix ``M``.

    ``extensions`` (springs, dofs, ...) is ``B``: the extension of each spring per unit of each coordinate;
    ``stiffness`` (springs, ...), ``mass`` (dofs, ...). ``blocks`` are an exact decomposition into invariant parts;
    ``whole`` is the system as one block. ``asymmetry`` (...), from 0 to 1, measures the coupling of the families. ``dofs``
    and ``body_names`` name coordinates and bodies; ``bodies`` (dofs,) is the number of the body of each coordinate.
    ``families`` is the number of families of modes.
    """

    extensions: Array
    stiffness: Array
    mass: Array
    blocks: tuple[Block, ...]
    whole: Block
    asymmetry: Array
    dofs: tuple[str, ...] = eqx.field(static=True)
    body_names: tuple[str, ...] = eqx.field(static=True)
    bodies: np.ndarray
    families: int = eqx.field(static=True)


class DrivenSprings(eqx.Module):
    """``M q'' + B^T diag(k) (B q - e) = f`` with harmonic errors e of the springs and forces f.

    ``force`` (dofs, ...), complex, is ``B^T diag(k) e + f``: amplitude times ``exp(i phase)`` for each coordinate.
    """

    springs: SpringSystem
    force: Array


def weighted_factor(extensions: Array, stiffness: Array, mass: Array) -> Array:
    """``diag(sqrt k) B M^(-1/2)``, shape (springs, dofs, ...)."""
    return jnp.sqrt(stiffness)[:, None] * extensions / jnp.sqrt(mass)
