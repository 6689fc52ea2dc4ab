"""Natural frequencies and modes of masses joined by springs: values, families, shapes, and modes tracked along an axis.

Frequencies come from singular values, modes from singular vectors of the factor ``diag(sqrt k) B M^(-1/2)``
(:mod:`~drivetrain_jax.analysis.numerics.singular_values`). The stiffness matrix is never formed, because it would square the
condition.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Parameter, Variable
from drivetrain_jax.analysis._base import Analysis, Outcome, Request, Solver, stacked
from drivetrain_jax.analysis.numerics.lanes import Constants, in_blocks, lane_count, path_entry, with_path
from drivetrain_jax.analysis.numerics.linear_algebra import looped_matmul
from drivetrain_jax.analysis.numerics.singular_values import (
    EPS,
    Bidiagonal,
    bidiagonal_form,
    bidiagonal_values,
    jacobi_vectors,
    singular_values,
)
from drivetrain_jax.resonances import operating_range
from drivetrain_jax.systems import Block, Model, SpringSystem, System

# Branches of modes along a path, by the modal assurance criterion (MAC) between neighbouring points.
#
# Modes that exchange their order in frequency keep their branches. At a veering, where two modes exchange their shapes,
# the branch goes with the shape. Modes of a multiple frequency are compared as a space.


# Share of a branch's shape in the space of its new frequency below which the shape of the new mode replaces it.
_CARRIED = 0.25
# Weight of the distance of single vectors, which decides between the modes of one space: their MAC are equal.
_OWN = 1e-3


def follow(vectors: Array, same: Array) -> tuple[Array, Array]:
    """``branch`` and ``mac``, both ``(L, n, ...)``, of modes along a path of ``L`` points.

    ``vectors`` (L, m, n, ...) are orthonormal shapes as columns, for example mass-weighted shapes. ``same`` (L, n, n, ...)
    marks modes of equal frequency at a point. ``branch`` (int32) is the number, from 1, of the mode at the first point that
    each mode continues. ``mac``, from 0 to 1, is the share of the branch's previous shape in the space of the mode (1 at the
    first point). Every branch continues at every point; pairs are formed by falling MAC. A point with ``vectors`` that are
    not finite has the order by frequency and a ``mac`` of NaN. Such points are skipped: the points on both sides are
    neighbours, and the first point is the first finite one.
    """
    n = vectors.shape[2]
    numbers = jnp.arange(1, n + 1, dtype=jnp.int32).reshape(n, *(1,) * (vectors.ndim - 3))
    first = jnp.broadcast_to(numbers, (n, *vectors.shape[3:]))

    def advance(reference: Array, point: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        shapes, equal = point
        known = jnp.all(jnp.isfinite(shapes), axis=(0, 1))
        shapes = jnp.where(known, shapes, 0.0)
        overlap = looped_matmul(jnp.swapaxes(reference, 0, 1), shapes)
        squares = overlap**2
        shared = jnp.sum(squares[:, :, None] * equal[None], axis=1)
        chosen = _pair(jnp.where(known, shared + _OWN * squares, jnp.eye(n).reshape(n, n, *(1,) * (shapes.ndim - 2))))
        branch = jnp.sum(chosen * first[:, None], axis=0)
        begun = jnp.any(reference != 0, axis=(0, 1))
        mac = jnp.where(begun, jnp.sum(chosen * shared, axis=0), 1.0)
        carried = _carry(overlap, shapes, equal, chosen)
        reference = jnp.where(known, carried, reference)
        return reference, (branch.astype(jnp.int32), jnp.where(known, jnp.minimum(mac, 1.0), jnp.nan))

    start = jnp.where(jnp.isfinite(vectors[0]), vectors[0], 0.0)
    _, (branch, mac) = lax.scan(advance, start, (vectors[1:], same[1:]))
    finite = jnp.all(jnp.isfinite(vectors[0]), axis=(0, 1))
    begin = jnp.where(finite, jnp.ones(first.shape), jnp.nan)
    return jnp.concatenate([first[None], branch]), jnp.concatenate([begin[None], mac])


def _pair(score: Array) -> Array:
    """Permutation matrix (n, n, ...) that pairs branches and modes by falling ``score`` (branches, modes, ...)."""
    n, lanes = score.shape[0], score.shape[2:]
    number = jnp.arange(n * n).reshape(n, n, *(1,) * len(lanes))

    def take(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        score, chosen = state
        best = jnp.argmax(score.reshape(n * n, *lanes), axis=0)
        hit = number == best
        row, column = jnp.any(hit, axis=1, keepdims=True), jnp.any(hit, axis=0, keepdims=True)
        return jnp.where(row | column, -1.0, score), chosen + hit

    return lax.fori_loop(0, n, take, (score, jnp.zeros(score.shape)))[1]


def _carry(overlap: Array, shapes: Array, equal: Array, chosen: Array) -> Array:
    """Shapes of the branches at this point: the projection of each shape on the space of its mode, if large enough."""
    inside = jnp.sum(chosen[:, :, None] * equal[None], axis=1) * overlap
    size = jnp.sum(inside**2, axis=1)
    keep = size > _CARRIED
    continued = inside / jnp.sqrt(jnp.where(keep, size, 1.0))[:, None]
    weights = jnp.where(keep[:, None], continued, chosen)
    return looped_matmul(shapes, jnp.swapaxes(weights, 0, 1))


# Modes of one block of a spring system, with the family of each mode or its shares of several families.
#
# Eigenvectors of a multiple frequency are arbitrary within their space. A rotation makes them diagonalise the operator whose
# eigenvalue is the number of the family, so that a pure mode in the space becomes an eigenvector. Eigenvectors of
# different frequencies stay unchanged, however close the frequencies are. Only the type of a mode may come from a vector
# rotated within a wider cluster.


# Code of a rigid mode; then follow the codes of the families and of a coupled mode.
RIGID = 0
# Largest share of a mode outside a family for which the mode belongs to the family.
PURITY = 1e-6
# Rounding units of the largest angular frequency within which frequencies count as equal.
_ROUNDINGS = 64
# Relative distance of neighbours in a cluster of angular frequencies, whose modes are typed, tracked and differentiated
# together.
CLUSTER = 5e-8
# Asymmetry up to which the families are coupled only at nearly equal frequencies; modes of wider clusters are then typed
# together.
SYMMETRIC = 2e-9
_CLUSTER_IF_SYMMETRIC = 5e-5
# Weight of motions along x, below the distance 1 of the numbers of the families, which take precedence.
_POLARISATION = 0.5


class Modes(NamedTuple):
    """Modes by rising angular ``frequency`` (n, N): mass-weighted ``vectors`` (coordinates, n, N) as columns or None, share
    of each family ``participation`` (n, families, N), code of the family as ``label`` (n, N), ``found`` (N,)."""

    frequency: Array
    vectors: Array | None
    participation: Array
    label: Array
    found: Array


def mode_type_names(families: tuple[str, ...]) -> tuple[str, ...]:
    """The types of modes by their codes."""
    return ("rigid", *families, "coupled")


def block_modes(block: Block, largest: Array, asymmetry: Array, families: int) -> Modes:
    """Modes of ``block``, in its coordinates; ``largest`` is the system's largest angular frequency.

    The frequencies are singular values and not norms ``|G v|`` of the factor times a vector: errors of rotated vectors, and
    for rigid modes the rounding of all rotations, would enter the norms.
    """
    frequency, values_found = singular_values(block.factor)
    vectors, vectors_found = jacobi_vectors(block.factor)
    order = jnp.argsort(jnp.sum(looped_matmul(block.factor, vectors) ** 2, axis=0), axis=0)
    vectors = jnp.take_along_axis(vectors, order[None], axis=1)
    rounding = jnp.broadcast_to(_ROUNDINGS * EPS * largest, frequency[1:].shape)
    separated = _turned(block, vectors, clusters(frequency, rounding), np.where(block.polar, _POLARISATION, 0.0))
    relative = jnp.where(asymmetry <= SYMMETRIC, _CLUSTER_IF_SYMMETRIC, CLUSTER)
    named = vectors
    if len(set(block.family)) > 1:
        named = _turned(block, vectors, clusters(frequency, jnp.maximum(relative * frequency[1:], rounding)), 0.0)
    share, label = _participation(block, separated, families), _label(_participation(block, named, families))
    return Modes(frequency, separated, share, label, values_found & vectors_found)


def _in_frame(block: Block, vectors: Array) -> Array:
    return vectors if block.frame is None else looped_matmul(jnp.swapaxes(block.frame, 0, 1), vectors)


def clusters(frequency: Array, tolerance: Array) -> Array:
    """Flags of modes i and j in the same cluster, (n, n, ...): neighbours at most ``tolerance`` (n - 1, ...) apart."""
    apart = (frequency[1:] - frequency[:-1] > tolerance).astype(jnp.int32)
    number = jnp.concatenate([jnp.zeros_like(frequency[:1], jnp.int32), jnp.cumsum(apart, axis=0)])
    return number[:, None] == number[None]


def one_frequency(frequency: Array, largest: Array) -> Array:
    """Flags of modes (n, n, ...) in the same cluster, in a system whose largest frequency is ``largest`` (...)."""
    return clusters(frequency, jnp.maximum(CLUSTER * frequency[1:], _ROUNDINGS * EPS * largest))


def _turned(block: Block, vectors: Array, near: Array, further: np.ndarray | float) -> Array:
    """``vectors`` rotated within the clusters ``near`` so that they are as pure as possible.

    ``further`` weighs the columns of the frame within each family. Vectors move no more than necessary.
    """
    weights = 1.0 + block.family + further
    if len(set(weights)) == 1:
        return vectors

    def turn() -> Array:
        amplitudes = _in_frame(block, vectors)
        weighted = weights.reshape(-1, 1, *(1,) * (vectors.ndim - 2)) * amplitudes
        operator = jnp.where(near, looped_matmul(jnp.swapaxes(amplitudes, 0, 1), weighted), 0.0)
        return looped_matmul(vectors, jacobi_vectors(operator)[0])

    # A cluster of several modes has neighbours. Most gears without symmetry have no such cluster and need no rotation.
    neighbours = jnp.diagonal(near, offset=1)
    return lax.cond(jnp.any(neighbours), turn, lambda: vectors)


def _participation(block: Block, vectors: Array, families: int) -> Array:
    shares = _in_frame(block, vectors) ** 2
    return jnp.stack([jnp.sum(shares[block.family == kind], axis=0) for kind in range(families)], axis=1)


def _label(participation: Array) -> Array:
    pure = participation > 1 - PURITY
    return jnp.where(jnp.any(pure, axis=1), 1 + jnp.argmax(pure, axis=1), 1 + participation.shape[1])


def is_rigid(frequency: Array, largest: Array) -> Array:
    """Flags of modes whose frequency is zero up to rounding of the largest frequency."""
    return frequency <= _ROUNDINGS * EPS * largest


Build = Callable[[Mapping[str, Any]], SpringSystem]

VARIABLES = (
    Variable("natural_frequency", "Hz", "natural frequency", ("mode",)),
    Variable("natural_frequency_error", "Hz", "estimated bound of the error of natural_frequency", ("mode",)),
    Variable("mode_type", "1", "type of the mode", ("mode",), "int8"),
    Variable("dominant_family", "1", "family with the largest share of the mode", ("mode",), "int8"),
    Variable("dominant_share", "1", "share of the mode in this family", ("mode",), lower=0.0),
    Variable("multiplicity", "1", "number of modes with this frequency", ("mode",), "int32"),
    Variable("participation", "1", "share of the mode in each family", ("mode", "family")),
    Variable("kinetic_energy", "1", "share of the mode's kinetic energy in each body", ("mode", "body")),
    # The unit is 1, because UDUNITS has no square root of a kilogram.
    Variable("mode_shape", "1", "mode shape of modal mass 1 kg", ("mode", "dof")),
    Variable("branch", "1", "number of the branch of the mode along the track", ("mode",), "int32"),
    Variable("mac", "1", "assurance criterion of the mode with its branch at the previous point", ("mode",)),
)
_SPECTRUM = {"natural_frequency", "natural_frequency_error"}
_FOLLOWED = {"branch", "mac"}
# Chunks of the engine, and lanes computed at a time, which fit into the cache of a core.
_SPECTRUM_CHUNK, _MODES_CHUNK, _LINES_CHUNK = 512, 256, 8
_CACHE = 1 << 16


def _lanes_at_a_time(blocks: tuple[Block, ...]) -> int:
    """Lanes whose matrices fill the cache, a multiple of the vector length."""
    entries = max(block.factor.shape[0] * block.factor.shape[1] for block in blocks)
    return int(np.clip(_CACHE // entries // 8 * 8, 16, 128))


def _blocks(model: SpringSystem, method: str) -> tuple[Block, ...]:
    return (model.whole,) if method == "full" else model.blocks


def _spectrum(build: Build, method: str, values: Mapping[str, Any], lanes: int) -> tuple[Array, Array]:
    """Angular frequencies (n, N), rising, and flags if all were found."""
    sample = _blocks(build(_first_lane(values)), method)
    copies = np.concatenate([np.full(block.factor.shape[1], block.copies) for block in sample])

    def reduce(part: Mapping[str, Any], count: int) -> Bidiagonal:
        factors = (_in_lanes(block.factor, count) for block in _blocks(build(part), method))
        return bidiagonal_form(*factors)

    values_of_blocks, complete = bidiagonal_values(in_blocks(reduce, values, lanes, _lanes_at_a_time(sample)))
    return jnp.sort(jnp.repeat(values_of_blocks, copies, axis=0, total_repeat_length=copies.sum()), axis=0), complete


def _first_lane(values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters with arrays reduced to their first entry, from which all shapes follow."""

    def first(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(first(entry) for entry in value)
        return value if np.ndim(value) == 0 else jnp.ravel(value)[0]

    return {name: first(value) for name, value in values.items()}


def _in_lanes(array: Array, lanes: int) -> Array:
    """``array`` (r, c) or (r, c, N) as (r, c, N)."""
    array = array if array.ndim == 3 else array[:, :, None]
    return jnp.broadcast_to(array, (*array.shape[:2], lanes))


def largest_frequency(model: SpringSystem, lanes: int) -> Array:
    """Upper bound of the angular frequencies, (N,): the Frobenius norm, at most 5 times the largest frequency."""
    return jnp.sqrt(jnp.sum(_in_lanes(model.whole.factor, lanes) ** 2, axis=(0, 1)))


def system_modes(model: SpringSystem, method: str, lanes: int, shapes: bool = True) -> Modes:
    """Modes of ``model`` for ``lanes`` lanes; the method ``full`` does not use its decomposition."""
    largest = largest_frequency(model, lanes)
    asymmetry = jnp.broadcast_to(model.asymmetry, (lanes,))
    blocks = [_as_lanes(block, lanes) for block in _blocks(model, method)]
    parts = [block_modes(block, largest, asymmetry, model.families) for block in blocks]

    def of_all(name: str) -> Array:
        pairs = zip(blocks, parts, strict=True)
        return jnp.concatenate([jnp.repeat(getattr(part, name), block.copies, axis=0) for block, part in pairs])

    frequency = of_all("frequency")
    order = jnp.argsort(frequency, axis=0)
    vectors = None
    if shapes:
        lifted = jnp.concatenate([_lift(b, p.vectors, lanes) for b, p in zip(blocks, parts, strict=True)], axis=1)  # pyright: ignore[reportArgumentType]
        vectors = jnp.take_along_axis(lifted, order[None], axis=1)
    return Modes(
        jnp.take_along_axis(frequency, order, axis=0),
        vectors,
        jnp.take_along_axis(of_all("participation"), order[:, None], axis=0),
        jnp.take_along_axis(of_all("label"), order, axis=0),
        jnp.all(jnp.stack([part.found for part in parts]), axis=0),
    )


def _as_lanes(block: Block, lanes: int) -> Block:
    frame = None if block.frame is None else _in_lanes(block.frame, lanes)
    return Block(_in_lanes(block.factor, lanes), block.family, block.polar, block.basis, frame)


def _lift(block: Block, vectors: Array, lanes: int) -> Array:
    """``vectors`` of a block in the coordinates of the system, (dofs, n * copies, N)."""
    basis = block.basis if block.basis.ndim == 4 else block.basis[..., None]
    lifted = sum(basis[:, c, None] * vectors[c, :, None] for c in range(basis.shape[1]))
    lifted = lifted.reshape(basis.shape[0], -1, lifted.shape[-1])  # pyright: ignore[reportAttributeAccessIssue]
    return jnp.broadcast_to(lifted, (*lifted.shape[:2], lanes))


def _canonical(vectors: Array) -> Array:
    """``vectors`` with signs that make the largest entry of every column positive."""
    # The first of entries that are equal up to rounding.
    places = 1e-9 * np.arange(len(vectors)).reshape(-1, 1, 1)
    largest = jnp.take_along_axis(vectors, jnp.argmax(jnp.abs(vectors) - places, 0)[None], axis=0)
    return vectors * jnp.where(largest < 0, -1.0, 1.0)


def _results(build: Build, request: Request, values: Mapping[str, Any], lanes: int) -> dict[str, Array]:
    """The requested results of every lane; instead of results along a track, the mass-weighted vectors for them."""
    wanted = set(request.outputs)
    followed = bool(request.options["track"])
    if wanted <= _SPECTRUM:
        frequency, complete = _spectrum(build, request.method, values, lanes)
        return _frequencies(frequency, complete, None)
    shapes = bool(wanted & {"mode_shape", "kinetic_energy"}) or followed

    def compute(part: Mapping[str, Any], count: int) -> dict[str, Array]:
        model = build(part)
        modes = system_modes(model, request.method, count, shapes)
        largest = largest_frequency(model, count)
        results = _frequencies(modes.frequency, modes.found, modes.participation)
        dominant = jnp.where(modes.found, jnp.argmax(modes.participation, axis=1), model.families)
        results["dominant_family"] = dominant.astype(jnp.int8)
        results["dominant_share"] = jnp.sort(results["participation"], axis=1)[:, -1]
        kind = jnp.where(is_rigid(modes.frequency, largest), RIGID, modes.label)
        results["mode_type"] = jnp.where(modes.found, kind, model.families + 1).astype(jnp.int8)
        if shapes:
            vectors = jnp.where(modes.found, _canonical(modes.vectors), jnp.nan)  # pyright: ignore[reportArgumentType]
            mass = model.mass[:, None] if model.mass.ndim == 2 else model.mass[:, None, None]
            results["mode_shape"] = jnp.swapaxes(vectors / jnp.sqrt(mass), 0, 1)
            squares = [vectors[model.bodies == body] ** 2 for body in range(model.bodies.max() + 1)]
            results["kinetic_energy"] = jnp.stack([jnp.sum(part, axis=0) for part in squares], axis=1)
            results["vectors"] = vectors
        equal = one_frequency(modes.frequency, largest)
        results["multiplicity"] = jnp.where(modes.found, jnp.sum(equal, axis=1), 0).astype(jnp.int32)
        results["equal"] = equal
        kept = {*request.outputs, "outcome"} | ({"vectors", "equal"} if followed else set())
        return {name: value for name, value in results.items() if name in kept}

    sample = _blocks(build(_first_lane(values)), request.method)
    return in_blocks(compute, values, lanes, max(_lanes_at_a_time(sample) // 2, 16))


def _frequencies(frequency: Array, complete: Array, participation: Array | None) -> dict[str, Array]:
    """Frequency, its error and outcome; NaN for missing modes."""
    value = jnp.where(complete, frequency / (2 * math.pi), jnp.nan)
    # Backward error of orthogonal transformations, equal for all modes of a point; true errors are about a tenth of it.
    error = 4 * EPS * math.sqrt(frequency.shape[0]) * value[-1]
    results = {"natural_frequency": value, "natural_frequency_error": jnp.broadcast_to(error, value.shape)}
    if participation is not None:
        results["participation"] = jnp.where(complete, participation, jnp.nan)
    finite = jnp.all(jnp.isfinite(frequency), axis=0)
    missing = jnp.where(finite, Outcome.NOT_CONVERGED, Outcome.NOT_FINITE)
    return results | {"outcome": jnp.where(complete, Outcome.SUCCESS, missing).astype(jnp.int8)}


def _solve(build: Build, request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    """All requested results, lanes last; with a track, its points first."""
    track, lanes = request.options["track"], lane_count(values, request.options["track"])
    wanted = (*request.outputs, "outcome")
    if not track:
        results = _results(build, request, values, lanes)
        return {name: results[name] for name in wanted}
    along = path_entry(values, track)
    values, length = with_path(values, track, lanes)
    results = {
        name: jnp.moveaxis(value.reshape(*value.shape[:-1], length, lanes), -2, 0)
        for name, value in _results(build, request, values, length * lanes).items()
    }
    if _FOLLOWED & set(request.outputs):
        order, place = _along(np.asarray(along))
        followed = follow(results["vectors"][order], results["equal"][order])
        results["branch"], results["mac"] = (values_along[place] for values_along in followed)
    return {name: results[name] for name in wanted}


def _along(values: np.ndarray) -> tuple[Any, Any]:
    """Positions that sort the values of a track, so that neighbours are compared, and positions that restore their order."""
    steps = np.diff(values)
    if (steps > 0).all() or (steps < 0).all():
        return slice(None), slice(None)
    order = np.argsort(values)
    return order, np.argsort(order)


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    chunk = _SPECTRUM_CHUNK if set(request.outputs) <= _SPECTRUM else _MODES_CHUNK
    chunk = _LINES_CHUNK if request.options["track"] else chunk
    solve = partial(_solve, system.models["modes"].build, request)
    return (Solver("singular values", solve, seconds=1e-4, chunk=chunk, short_loops=True),)


def described(model: Model, fixed: Mapping[str, Any]) -> Any:
    """The object that ``model`` builds, traced only: its names and sizes do not depend on varying parameters."""
    values = {name: fixed.get(name, 1.0) for name in model.parameters}
    models: list[Any] = []
    jax.eval_shape(lambda: models.append(model.build(values)))
    return models[0]


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    """Modes counted from 1, families, bodies and coordinates."""
    operating_range(request.options)
    followed = sorted(_FOLLOWED & set(request.outputs))
    if followed and not request.options["track"]:
        raise InputError(f"outputs: {followed[0]!r} needs the option track; expected the name of an axis")
    springs: SpringSystem = described(system.models["modes"], fixed)
    return (
        Dimension("mode", "number of the mode", tuple(range(1, len(springs.dofs) + 1))),
        Dimension("family", "family of modes", system.mode_families),
        Dimension("body", "body", springs.body_names),
        Dimension("dof", "coordinate", springs.dofs),
    )


# Rounding of derivatives within a cluster: relative to these derivatives, and to the largest derivative of all modes.
_ROUNDING, _OF_LARGEST = 1e-8, 1e-13


def _derivatives(
    system: type[System], request: Request, parameters: Any, constants: Constants, results: Mapping[str, Array]
) -> dict[str, Array]:
    """Jacobian of the frequencies, ``df = u^T (dK - (2 pi f)^2 dM) u / (8 pi^2 f)`` with modes u of unit modal mass.

    The Jacobian is formed spring by spring, without a stiffness matrix. Entries are NaN in two cases: where a parameter
    splits equal frequencies (along the eigenvalues of ``u_i^T (dK - (2 pi f)^2 dM) u_j``), and where the frequency of a
    rigid mode rises from zero like sqrt(k).
    """

    def model(parameters: Any) -> SpringSystem:
        return system.models["modes"].build(eqx.combine(parameters, constants.tree))

    here = model(parameters)
    modes, largest = system_modes(here, "auto", 1), largest_frequency(here, 1)
    near, still = one_frequency(modes.frequency, largest)[..., 0], is_rigid(modes.frequency, largest)
    omega = jnp.where(modes.found, modes.frequency, jnp.nan)[:, 0]
    shapes = modes.vectors[..., 0] / jnp.sqrt(here.mass)[:, None]  # pyright: ignore[reportOptionalSubscript]

    def excess(parameters: Any) -> Array:
        """Zero up to rounding; its derivatives at fixed shapes are those of ``(2 pi f)^2``."""
        springs = model(parameters)
        stretched = springs.extensions @ shapes
        elastic = stretched.T @ (springs.stiffness[:, None] * stretched)
        return elastic - omega[:, None] * omega * (shapes.T @ (springs.mass[:, None] * shapes))

    squares = jnp.where(near[..., None], stacked(jax.jacfwd(excess)(parameters)), 0.0)
    mean = near @ jnp.diagonal(squares).T / jnp.sum(near, axis=1)[:, None]
    within, largest = jnp.max(jnp.abs(squares), axis=1), jnp.max(jnp.abs(squares), axis=(0, 1))
    apart = jnp.max(jnp.abs(squares - jnp.eye(len(omega))[..., None] * mean), axis=1)
    split = apart > _ROUNDING * within + _OF_LARGEST * largest
    slope = jnp.where(split, jnp.nan, mean) / (4 * math.pi * jnp.where(still, 1.0, modes.frequency))
    starts = jnp.abs(mean) > _ROUNDING * largest
    return {"natural_frequency": jnp.where(still, jnp.where(starts, jnp.nan, 0.0), slope)}


def _of_system(system: type[System]) -> dict[str, Any]:
    """The variables, with types of modes from the families of the system."""
    families = system.mode_families
    flags = {"mode_type": mode_type_names(families), "dominant_family": (*families, "none")}
    return {"variables": tuple(replace(v, flags=flags.get(v.name, v.flags)) for v in VARIABLES)}


OPTIONS = (
    Parameter("track", "1", "axis along which modes are tracked", default="", text=True),
    Parameter("operating_min", "rpm", "lowest operating speed", default=0.0, lower=0.0),
    Parameter("operating_max", "rpm", "highest operating speed (0: not given)", default=0.0, lower=0.0),
    Parameter(
        "orders", "1", "further orders, such as an engine's", default=(), listed=True, lower=0.0, open_lower=True
    ),
)
ANALYSIS = Analysis(
    name="modes",
    title="natural frequencies and modes",
    variables=VARIABLES,
    default_outputs=("natural_frequency", "mode_type", "dominant_family", "dominant_share"),
    methods=dict.fromkeys(("auto", "full"), tuple(option.name for option in OPTIONS)),
    method_titles={"auto": "by the invariant blocks of a symmetry, if there is one", "full": "always the whole matrix"},
    options=OPTIONS,
    solvers=_solvers,
    dimensions=_dimensions,
    derivatives=_derivatives,
    path_axis=lambda _, request: request.options["track"] or None,
    of_system=_of_system,
)
