"""The lateral vibration of a stepped shaft: the model of the analysis ``critical_speeds``."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array


class Shaft(NamedTuple):
    """A shaft of ``n`` uniform segments between ``n + 1`` nodes (the ends A, D and the joints).

    Every field is an array whose first axis counts segments, nodes or joints; further axes are lanes and broadcast
    against each other. ``None`` leaves an effect out of the computation altogether.

    ``length`` [m], ``EI`` [N m^2]: shape ``(n, ...)``, positive. ``rhoA`` [kg/m]: ``(n, ...)``, 0 for a segment without
    mass. ``k`` [N/m]: springs to ground at the nodes, ``(n + 1, ...)``, 0 to infinity (a rigid support). ``m`` [kg]: lumped
    masses at the nodes, ``(n + 1, ...)``.
    ``k_hinge`` [N m/rad]: rotational stiffness of the joints, ``(n - 1, ...)``, 0 (a hinge) to infinity (rigid).
    ``kGA`` [N]: shear stiffness ``(n, ...)``, infinity for a segment without shear; ``rhoI`` [kg m]: rotary inertia per
    length ``(n, ...)``. With one of these two a segment is a Timoshenko beam, otherwise an Euler-Bernoulli beam.
    ``k_rot`` [N m/rad]: rotational springs to ground at the nodes, ``(n + 1, ...)``, 0 between the ends, up to infinity (a
    clamped end). ``inertia`` [kg m^2]: rotary inertia of discs at the nodes, ``(n + 1, ...)``; half of it sits on each side
    of an elastic joint.
    """

    length: Any
    EI: Any
    rhoA: Any
    k: Any
    m: Any = None
    k_hinge: Any = None
    kGA: Any = None
    rhoI: Any = None
    k_rot: Any = None
    inertia: Any = None

    @property
    def segments(self) -> int:
        """The number of segments ``n``."""
        return len(self.length)

    @property
    def is_timoshenko(self) -> bool:
        """True if shear or rotary inertia is part of the model."""
        return self.kGA is not None or self.rhoI is not None

    @property
    def lanes(self) -> tuple[int, ...]:
        """Shape of the lanes of all fields together."""
        return jnp.broadcast_shapes(*(field.shape[1:] for field in self if field is not None))  # pyright: ignore[reportReturnType]

    def mirrored(self) -> Shaft:
        """The same shaft seen from its other end."""
        return Shaft(*(None if field is None else field[::-1] for field in self))

    def spread(self) -> Shaft:
        """The same shaft with every field spread over all lanes."""
        lanes = self.lanes
        return Shaft(*(None if f is None else jnp.broadcast_to(f, (len(f), *lanes)) for f in self.arrays()))

    def arrays(self) -> Shaft:
        """The shaft with all fields as arrays in double precision, with the axes of the lanes."""
        fields = Shaft(*(None if field is None else stack(field) for field in self))
        axes = len(fields.lanes) + 1

        def aligned(field: Array) -> Array:
            return field.reshape(len(field), *(1,) * (axes - field.ndim), *field.shape[1:])

        return Shaft(*(None if field is None else aligned(field) for field in fields))


def stack(entries: Any) -> Array:
    """One array from numbers and arrays whose lanes broadcast, shape ``(len(entries), ...)``."""
    if hasattr(entries, "ndim"):
        return jnp.asarray(entries, float)
    return jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(entry, float) for entry in entries)))
