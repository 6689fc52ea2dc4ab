"""The planetary gear: Shahabi & Sheykh Samani 2016 against this package."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

import drivetrain_jax as dt
from benchmarks.validation.document import Page, inventory, section, table
from tests.oracles.planetary_reference import TABLE_2, exact_frequencies, matrices

# The paper divides by 2 x 3.14 instead of 2 pi, and cuts after the first decimal.
PRINTED_PI = math.pi / 3.14
PAIRS = (0, 80, 180, 260)
SIX = (0, 80, 120, 180, 260, 300)
FIVE = (0, 72, 144, 252, 324)
THREE = (0, 77, 201)
BALANCED_FIVE = (0, 30, 120, 210, 240)
# Printed values by table. None: not printed for that mode.
TABLE_1 = {1: 0.0, 6: 1537.3, 7: 1809.0, 10: 1971.5, 13: 2626.9, 14: 5966.7, 15: 6985.2, 18: 7777.4, 21: 13077.7}
TABLE_3 = (713.3, 739.0, 1085.5, 1095.3, 1859.2, 1937.0, 2330.6, 2357.6, 7053.6, 7328.2, 9900.5, 10958.6)
TABLE_3_EQUAL = {"translational": (727.0, 1091.0, 1892.8, 2342.5, 7189.9, 10437.6)}
TABLE_4 = {
    "rotational": (0.0, 1581.3, 2033.6, 2625.6, 8346.9, 15353.8),
    "planet": (1809.0, 5966.7, 6985.2),
    "translational": (675.3, 706.5, 1027.8, 1069.3, 1840.9, 1943.9, 2496.0, 2535.0, 7316.3, 7814.4, 10913.1, 12750.7),
}
# Equal spacing is quoted from the paper's reference [4], with the true pi.
TABLE_5_EQUAL = {
    "rotational": (0.0, 1475.7, 1930.3, 2658.3, 7462.8, 11775.2),
    "translational": (743.2, 1102.4, 1896.0, 2276.4, 6986.3, 9647.9),
}
TABLE_5_UNEQUAL = (0.0, 1476.7, 1931.2, 2659.7, 7464.5, 11778.1)
# Angles of the second and third planet whose frequencies are nearest to the column for unequal spacing.
NEAREST_THREE = (117.77859, 242.20544)
TABLE_6_EQUAL = {
    "rotational": (0.0, 1567.4, 2006.1, 2614.8, 8065.4, 14253.1),
    "translational": (710.0, 1072.0, 1888.1, 2425.3, 7382.4, 11172.3),
    "planet": (1808.2, 5963.8, 6981.7),
}
TABLE_6_UNEQUAL = (0.0, 1568.1, 2007.8, 2615.4, 8070.5, 14260.8)
TABLE_7_PAIRS = (713.3, 739.0, 988.2, 1085.5, 1085.5, 1809.0, 1839.3, 1859.6, 1937.0, 1937.0)
TABLE_7_EQUAL = (743.5, 743.5, 1002.0, 1102.9, 1102.9, 1845.9, 1896.9, 1896.9, 2277.5, 2277.5)
HEAD = ["mode", "type", "computed", "independent, 50 digits", "printed", "computed x pi/3.14", "difference"]
# Of frequencies that the paper quotes from its reference [4].
QUOTED = [*HEAD[:5], "computed (quoted with the true pi)", HEAD[6]]


def gear(degrees: Sequence[float], **fixed: float) -> Any:
    """Frequencies, types and participation by the package, planets at ``degrees``."""
    angles = [math.radians(angle) for angle in degrees]
    outputs = ["natural_frequency", "mode_type", "participation"]
    scene = {"system": "planetary", "analysis": "modes", "outputs": outputs}
    return dt.run(scene | {"title": "validation", "fixed": {"planet_angle": angles, **fixed}})


def kinds(ds: Any) -> np.ndarray:
    """The type of every mode by name; the rigid rotation counts as rotational, as in the paper."""
    names = np.array(ds.mode_type.attrs["flag_meanings"].split())[ds.mode_type.values]
    return np.where(names == "rigid", "rotational", names)


def oracle(degrees: Sequence[float], **fixed: float) -> np.ndarray:
    """The same frequencies from the equations of motion in 50 digits."""
    angles = tuple(math.radians(angle) for angle in degrees)
    return np.array(exact_frequencies(TABLE_2 | fixed | {"planet_angle": angles}))


def _row(
    mode: int, kind: str, found: float, exact: float, printed: float | None, factor: float = PRINTED_PI
) -> list[str]:
    shown = "-" if printed is None else f"{printed:.1f}"
    difference = "-" if printed is None else f"{printed - factor * found:+z.2f}"
    return [str(mode), kind, f"{found:.3f}", f"{exact:.3f}", shown, f"{factor * found:.3f}", difference]


def _by_kind(ds: Any, exact: np.ndarray, printed: dict[str, Sequence[float]], factor: float) -> list[list[str]]:
    """Rows of distinct frequencies of each kind and the printed ones, in order."""
    frequency, types = ds.natural_frequency.values, kinds(ds)
    rows = []
    for kind, values in printed.items():
        own = np.flatnonzero(types == kind)
        distinct = [
            i for n, i in enumerate(own) if n == 0 or frequency[i] - frequency[own[n - 1]] > 1e-6 * frequency[i]
        ]
        if len(distinct) != len(values):
            raise ValueError(f"{kind}: {len(distinct)} frequencies computed, {len(values)} printed")
        rows += [_row(i + 1, kind, frequency[i], exact[i], v, factor) for i, v in zip(distinct, values, strict=True)]
    return rows


def table_1() -> str:
    """Four planets in opposite pairs, the modes that equal spacing has too."""
    ds, exact = gear(PAIRS), oracle(PAIRS)
    frequency, types = ds.natural_frequency.values, kinds(ds)
    rows = [_row(i, types[i - 1], frequency[i - 1], exact[i - 1], printed) for i, printed in TABLE_1.items()]
    text = (
        "Section 4 of the paper compares its planets in pairs with the equally spaced ones of Lin & Parker, by the modes "
        'that both have. It reports errors of "0.04 %". The factor is pi/3.14 = 1.000507: the frequencies were divided by '
        "2 x 3.14, and truncated after one decimal. Computed values times pi/3.14, truncated, give every entry."
    )
    return section("Table 1: four planets at 0, 80, 180, 260 degrees (Hz)", text, HEAD, rows)


def table_3() -> str:
    """Four planets in opposite pairs."""
    ds, exact = gear(PAIRS), oracle(PAIRS)
    rotational = tuple(TABLE_1[i] for i in (1, 6, 10, 13, 18, 21))
    planets = tuple(TABLE_1[i] for i in (7, 14, 15))
    printed = {"rotational": rotational, "planet": planets, "translational": TABLE_3}
    text = (
        "Here sum exp(i psi) = 0, but sum exp(2 i psi) is not zero. The translational pairs split and all other "
        "modes stay, as the paper says."
    )
    title = "Table 3: four planets at 0, 80, 180, 260 degrees (Hz)"
    unequal = section(title, text, HEAD, _by_kind(ds, exact, printed, PRINTED_PI))
    degrees = (0, 90, 180, 270)
    equal = table(QUOTED, _by_kind(gear(degrees), oracle(degrees), TABLE_3_EQUAL, 1.0))
    return f"{unequal}\nThe translational doublets of equal spacing:\n\n{equal}"


def table_4() -> str:
    """Six planets in opposite pairs."""
    rows = _by_kind(gear(SIX), oracle(SIX), TABLE_4, PRINTED_PI)
    return section("Table 4: six planets at 0, 80, 120, 180, 260, 300 degrees (Hz)", "", HEAD, rows)


def table_5() -> str:
    """Three planets."""
    degrees = (0, 120, 240)
    ds, exact = gear(degrees), oracle(degrees)
    equal = section("Table 5: three planets (Hz)", "", QUOTED, _by_kind(ds, exact, TABLE_5_EQUAL, 1.0))
    own = table(HEAD, _by_kind(ds, exact, {"rotational": TABLE_5_UNEQUAL}, PRINTED_PI))
    nearest = [f"{angle:.1f}" for angle in NEAREST_THREE]
    left = [_distance_of_unequal_three(NEAREST_THREE, 1.0), _distance_of_unequal_three((120, 240), PRINTED_PI)]
    text = (
        "The column for unequal spacing states no angles, and no angles reproduce it. All angles were "
        "searched in steps of 4 degrees, and the best ones refined. With the true pi the closest angles are "
        f"{nearest[0]} and {nearest[1]} degrees, with a difference of {left[0]:.1f} Hz. With pi/3.14 equal spacing is "
        f"closest, with {left[1]:.1f} Hz (second table). Three planets have sum exp(i psi) = 0 only at equal spacing. Any "
        "unequal spacing couples rotation with translation, and the modes that the paper calls missing exist.\n"
    )
    return f"{equal}\n{text}\n{own}"


def _distance_of_unequal_three(angles: Sequence[float], factor: float) -> float:
    """Largest distance of the column for unequal spacing from the nearest frequencies of a gear.

    The gear has planets at 0 and ``angles``.
    """
    found = factor * oracle((0, *angles))
    return max(float(np.abs(found - value).min()) for value in TABLE_5_UNEQUAL)


def table_6() -> str:
    """Five planets, and a counterexample to the paper's statement about odd numbers."""
    degrees = tuple(72 * i for i in range(5))
    ds, exact = gear(degrees), oracle(degrees)
    equal = section("Table 6: five planets (Hz)", "Equally spaced:", QUOTED, _by_kind(ds, exact, TABLE_6_EQUAL, 1.0))
    return f"{equal}\n{_unequal_five()}\n{_balanced_five(ds)}"


def _unequal_five() -> str:
    ds, exact = gear(FIVE), oracle(FIVE)
    frequency, types, shares = ds.natural_frequency.values, kinds(ds), ds.participation.values
    printed = dict.fromkeys(range(len(frequency)))
    for value in TABLE_6_UNEQUAL:
        candidates = [i for i in range(len(frequency)) if shares[i, 0] > 0.5]
        printed[min(candidates, key=lambda i: abs(frequency[i] * PRINTED_PI - value))] = value
    head = [*HEAD[:2], "rotational share", *HEAD[2:]]
    rows = []
    for i, value in printed.items():
        row = _row(i + 1, types[i], frequency[i], exact[i], value)
        rows.append([*row[:2], f"{shares[i, 0]:.4f}", *row[2:]])
    text = (
        "For 0, 72, 144, 252, 324 degrees the paper states that the rotational modes stay and the translational "
        "ones vanish. Uncoupled rotation needs sum exp(i psi) = 0. The sum of the sines alone, (30b), which these "
        "angles satisfy, is not sufficient. Here |sum exp(i psi)|/5 = 0.2: all modes exist, and all except rigid "
        "and planet modes are coupled. The printed values agree within 1.1 Hz with equal spacing times pi/3.14. The "
        "table also lists the closest coupled modes.\n"
    )
    return f"{text}\n{table(head, rows)}"


def _balanced_five(equal: Any) -> str:
    ds = gear(BALANCED_FIVE)
    pair = (one.natural_frequency.values[kinds(one) == "rotational"] for one in (ds, equal))
    count = int((kinds(ds) == "translational").sum())
    text = (
        "At 0, 30, 120, 210, 240 degrees five unequally spaced planets are balanced. The rotational modes are those "
        f"of equal spacing, and {count} translational modes exist.\n"
    )
    rows = [f"{a:.6f} | {b:.6f}" for a, b in zip(*pair, strict=True)]
    return f"{text}\n{table('rotational, balanced unequal spacing | rotational, equal spacing', rows)}"


def table_7() -> str:
    """Table 7: the carrier on a stiff spring."""
    parts = []
    for title, degrees, printed in (
        ("Four planets at 0, 80, 180, 260 degrees", PAIRS, TABLE_7_PAIRS),
        ("Three equally spaced planets", (0, 120, 240), TABLE_7_EQUAL),
    ):
        ds, exact = gear(degrees, k_cu=1e9), oracle(degrees, k_cu=1e9)
        stiff = gear(degrees, k_cu=1e10).natural_frequency.values
        frequency, types = ds.natural_frequency.values, kinds(ds)
        rows = [
            [*_row(i + 1, types[i], frequency[i], exact[i], value), f"{stiff[i] * PRINTED_PI:.2f}"]
            for i, value in enumerate(printed)
        ]
        parts.append(f"{title}:\n\n{table([*HEAD, 'with k_cu = 1e10, x pi/3.14'], rows)}")
    text = (
        "The text states k_cu = 1e10 N/m; the values belong to 1e9. The table of four planets lists 1085.5 twice; "
        "the second replaces 1095.3 of Table 3, the other half of the split pair. It lists 1937.0 twice, but only "
        "one such mode exists. The next mode is the rotational one that k_cu raises from 1971.6 to 2292.3 (x "
        "pi/3.14). Table 3 has 1859.2 where this table has 1859.6. The paper calls modes such as 713.3 and 1085.5 "
        '"distinct" and "degenerate"; they are translational modes, which k_cu does not affect.\n'
    )
    return "## Table 7: carrier held (Hz)\n\n" + "\n".join([text, *parts])


def rotational() -> str:
    """The model of (39) and (40), for which the paper prints no values."""
    angles = tuple(math.radians(angle) for angle in PAIRS)
    found = dt.modes(dt.Planetary(planet_angle=angles, model="rotational"), outputs=["natural_frequency", "mode_type"])
    exact = _with_centres_held(angles)
    names = {0: "distinct (rigid rotation)", 1: "distinct (rotational)", 3: "degenerate (planet)"}
    pairs = zip(found.natural_frequency, found.mode_type, exact, strict=True)
    rows = [[str(i), names[int(kind)], f"{f:.3f}", f"{x:.3f}"] for i, (f, kind, x) in enumerate(pairs, 1)]
    text = (
        "Translations are held, and the carrier carries the centres of the planets. In distinct modes all bodies "
        "rotate, in degenerate ones the planets alone, N - 1 times at sqrt((k_sp + k_rp)/I_p)/(2 pi). The angles of "
        'the planets have no influence. "Independent": NumPy, the plane gear under the constraint eta_n = u_c.'
    )
    head = "mode | paper's type (ours) | computed | independent"
    return section("Rotational model, (39) and (40): four planets (Hz)", text, head, rows)


def _with_centres_held(angles: Sequence[float]) -> np.ndarray:
    mass, stiffness = (np.array(x, float) for x in matrices(TABLE_2 | {"planet_angle": angles}))
    n = len(angles)
    constraint = np.zeros((9 + 3 * n, 3 + n))
    constraint[[2, 5, 8], [0, 1, 2]] = constraint[10::3, 0] = 1
    constraint[11::3, 3:] = np.eye(n)
    inertia, held = (constraint.T @ x @ constraint for x in (np.diag(mass), stiffness))
    root = np.sqrt(np.diag(inertia))
    return np.sqrt(np.maximum(np.linalg.eigvalsh(held / root / root[:, None]), 0)) / (2 * math.pi)


def dominant() -> str:
    """Dominant families of coupled modes."""
    rows = []
    for title, degrees in (("five planets, one 3 degrees off", (0, 75, 144, 216, 288)), ("three at 0, 77, 201", THREE)):
        found = _shares(degrees)
        for family in ("rotational", "translational"):
            shares = found[family]
            rows.append([title, family, str(len(shares)), f"{min(shares):.2%}", f"{max(shares):.2%}"])
    text = (
        "A mode has a type if less than 1e-6 of it lies outside one family. Otherwise it is coupled, and "
        "`dominant_family` with `dominant_share` says what it mostly is."
    )
    head = "gear | dominant family of coupled modes | modes | least share | largest share"
    return section("Coupled modes by their dominant family", text, head, rows)


def _shares(degrees: Sequence[float]) -> dict[str, list[float]]:
    """Shares of the coupled modes in their dominant family, by family."""
    found = dt.modes(dt.Planetary(planet_angle=tuple(map(math.radians, degrees))))
    shares: dict[str, list[float]] = {"rotational": [], "translational": []}
    for kind, family, share in zip(found.mode_type, found.dominant_family, found.dominant_share, strict=True):
        if int(kind) == 4:
            shares[("rotational", "translational")[int(family)]].append(float(share))
    return shares


def everything() -> str:
    """The inventory of the paper."""
    turning = dt.modes(dt.Planetary(model="rotational"), outputs=["natural_frequency", "mode_type"])
    frequency, types = np.asarray(turning.natural_frequency), np.asarray(turning.mode_type)
    equal, unequal = gear((0, 90, 180, 270)), gear(PAIRS)
    kept = [np.isin(kinds(ds), ("rotational", "planet")) for ds in (equal, unequal)]
    pair = [ds.natural_frequency.values[own][1:] for ds, own in zip((equal, unequal), kept, strict=True)]
    return inventory(
        "planetary", distinct=", ".join(f"{f:.2f}" for f in np.abs(frequency[types < 2])),
        degenerate=f"{frequency[types == 3][0]:.3f}", times=str((types == 3).sum()),
        three=str(len(_shares(THREE)["translational"])), even=f"{np.abs(pair[0] / pair[1] - 1).max():.1g}",
    )  # fmt: skip


def page(full: bool) -> Page:
    """The page of the planetary gear; ``full`` has no effect."""
    del full
    introduction = (
        "Shahabi & Sheykh Samani 2016 against this package: natural frequencies of planetary gears with unequally spaced "
        "planets, computed with the true pi, beside the printed values and beside computed x pi/3.14. The corrected "
        "equations are in [theory/planetary.md](../theory/planetary.md)."
    )
    tables = (table_1, table_3, table_4, table_5, table_6, table_7)
    sections = [section() for section in (*tables, rotational, dominant, everything)]
    return Page("Validation of the planetary gear", introduction, sections)
