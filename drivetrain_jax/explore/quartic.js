// Spectral radius of four multipliers in closed form, with Smith's discs as bound: analysis/floquet/quartic.py and
// atlas/charts.py, one point at a time. A point is [[A, B], [C, D]] = Phi, its 16 entries by rows.

import { EPS, product } from "./linear.js";

const NEWTON_STEPS = 9;
// Roundings in a coefficient, twice as many as in Python: sums have another order here, so what is too close stays undecided.
const ROUNDINGS = 32;

/**
 * e1, e2, e3 of `phi[at ..]` into `out[0 .. 2]`, bounds of their rounding into `out[3 .. 5]`, and bounds of their changes by an
 * error of phi of the norm `error` into `out[6 .. 8]`.
 */
export function invariants(phi, at, out, error) {
  const a11 = phi[at], a12 = phi[at + 1], b11 = phi[at + 2], b12 = phi[at + 3];
  const a21 = phi[at + 4], a22 = phi[at + 5], b21 = phi[at + 6], b22 = phi[at + 7];
  const c11 = phi[at + 8], c12 = phi[at + 9], d11 = phi[at + 10], d12 = phi[at + 11];
  const c21 = phi[at + 12], c22 = phi[at + 13], d21 = phi[at + 14], d22 = phi[at + 15];
  const s11 = d11 * a11 + d21 * a21 + b11 * c11 + b21 * c21, s12 = d11 * a12 + d21 * a22 + b11 * c12 + b21 * c22;
  const s21 = d12 * a11 + d22 * a21 + b12 * c11 + b22 * c21, s22 = d12 * a12 + d22 * a22 + b12 * c12 + b22 * c22;
  const u11 = 2 * (d11 * b11 + d21 * b21), u22 = 2 * (d12 * b12 + d22 * b22);
  const u12 = d11 * b12 + d21 * b22 + d12 * b11 + d22 * b21;
  const v11 = 2 * (c11 * a11 + c21 * a21), v22 = 2 * (c12 * a12 + c22 * a22);
  const v12 = c11 * a12 + c21 * a22 + c12 * a11 + c22 * a21;
  const det = s11 * s22 - s12 * s21;
  out[0] = 2 * (s11 + s22);
  out[1] = 2 * det + s11 * s11 - u11 * v11 + s22 * s22 - u22 * v22 + 2 * (s11 * s22 - u12 * v12);
  // Principal minors without the first or the second row; the reversor makes the other two equal to them.
  const first = s22 * det - u12 * (v12 * s22 - v22 * s21) + u22 * (v12 * s12 - v22 * s11);
  const second = s11 * det - u11 * (v11 * s22 - v12 * s21) + u12 * (v11 * s12 - v12 * s11);
  out[2] = 2 * (first + second);
  let size = 0;
  for (let i = at; i < at + 16; i++) size += phi[i] * phi[i];
  const squares = s11 * s11 + s12 * s12 + s21 * s21 + s22 * s22;
  const others = u11 * u11 + 2 * u12 * u12 + u22 * u22 + v11 * v11 + 2 * v12 * v12 + v22 * v22;
  const z = Math.sqrt(2 * squares + others);
  // 2 |Phi G| with G_2 = e1 I - Z and G_3 = e2 I - G_2 Z are the derivatives of e2 and e3 by the entries of Phi.
  const Z = [s11, s12, u11, u12, s21, s22, u12, u22, v11, v12, s11, s21, v12, v22, s12, s22];
  const one = phi.subarray(at, at + 16), two = product(one, Z, 4);
  for (let i = 0; i < 16; i++) two[i] = out[0] * one[i] - two[i];
  const three = product(two, Z, 4);
  for (let i = 0; i < 16; i++) three[i] = out[1] * one[i] - three[i];
  const norm = (x) => Math.sqrt(x.reduce((sum, v) => sum + v * v, 0));
  const changed = (2 * Math.sqrt(size) + error) * error, rounding = ROUNDINGS * EPS * size;
  out[3] = rounding;
  out[4] = rounding * z;
  out[5] = rounding * z * z;
  out[6] = changed;
  out[7] = 2 * norm(two) * error + 4 * changed * changed;
  out[8] = 2 * norm(three) * error + 10 * (z + changed) * changed * changed;
}

/** A root >= 0 of w^3 + p2 w^2 + p1 w + p0, p0 <= 0, by Newton's method from where it converges monotonically. */
function cubicRoot(p2, p1, p0) {
  const bend = -p2 / 3;
  let w = 0;
  if (!(bend > 0 && ((bend + p2) * bend + p1) * bend + p0 > 0)) {
    const m2 = p2 < 0 ? -p2 : 0, m1 = p1 < 0 ? -p1 : 0;
    w = Math.max((m2 + Math.sqrt(m2 * m2 + 4 * (m1 - 4 * p0))) / 2, 0.25);
    if (p2 > 0) {
      // w^3 may be left out.
      const root = Math.sqrt(Math.max(p1 * p1 - 4 * p2 * p0, 0));
      const top = p1 > 0 ? -2 * p0 : root - p1, bottom = p1 > 0 ? p1 + root : 2 * p2;
      if (top < w * bottom) w = top / bottom;
    }
  }
  for (let k = 0; k < NEWTON_STEPS; k++) {
    const slope = (3 * w + 2 * p2) * w + p1;
    if (!(slope > 0)) break;
    const step = (((w + p2) * w + p1) * w + p0) / slope;
    w = Math.max(w - step, 0);
    // Convergence is quadratic; whatever is missing shows in the product of the factors.
    if (Math.abs(step) <= 1e-9 * w) break;
  }
  return w;
}

/**
 * Spectral radius, bound, and 1 if the bound is much wider than it need be, into `out[0 .. 2]`.
 *
 * det(sigma I - Z) = sigma^4 - e1 sigma^3 + e2 sigma^2 - e3 sigma + kappa^4, whose coefficients are wrong by at most d1 .. d4.
 */
export function radius(e1, e2, e3, kappa, d1, d2, d3, d4, out) {
  const inverse = 1 / kappa, a = e1 * inverse, b = e2 * inverse * inverse, g = e3 * inverse * inverse * inverse;
  const plus = ((a + g) * (a + g)) / 4, minus = ((a - g) * (a - g)) / 4, e = 4 * b - 8;
  const w = cubicRoot((16 - e) / 16, (plus - minus - e) / 16, -minus / 16);
  const cosh = Math.sqrt(1 + w), sinh = Math.sqrt(w), total = (a + g) / (2 * cosh);
  let difference = Math.sqrt(Math.max(total * total - 4 * (b - 2 * (1 + 2 * w)), 0));
  if (sinh > difference) difference = (a - g) / (2 * sinh);
  else if (a < g) difference = -difference;
  const growth = cosh + sinh, p1 = (total + difference) / 4, p2 = (total - difference) / 4;
  const m1 = kappa * growth, m2 = kappa / growth;
  // Two quadratics sigma^2 - 2 half sigma + m^2; `gap` is half the distance of the roots.
  const radicand1 = (p1 - 1) * (p1 + 1), radicand2 = (p2 - 1) * (p2 + 1);
  const half1 = m1 * p1, half2 = m2 * p2, real1 = radicand1 >= 0, real2 = radicand2 >= 0;
  const gap1 = m1 * Math.sqrt(Math.abs(radicand1)), gap2 = m2 * Math.sqrt(Math.abs(radicand2));
  const large1 = real1 ? Math.abs(half1) + gap1 : m1, large2 = real2 ? Math.abs(half2) + gap2 : m2;
  const t1 = 2 * half1, t2 = 2 * half2, q1 = m1 * m1, q2 = m2 * m2;
  const x1 = Math.abs(e1 - (t1 + t2)) + d1, x2 = Math.abs(e2 - (q1 + q2 + t1 * t2)) + d2;
  const x3 = Math.abs(e3 - (t1 * q2 + t2 * q1)) + d3;
  const one = large1 >= large2;
  const half = one ? half1 : half2, gap = one ? gap1 : gap2, real = one ? real1 : real2, modulus = one ? m1 : m2;
  const oHalf = one ? half2 : half1, oGap = one ? gap2 : gap1, oReal = one ? real2 : real1, oModulus = one ? m2 : m1;
  const rho = one ? large1 : large2, m = one ? large2 : large1;
  const eps = 2 * (((x1 * rho + x2) * rho + x3) * rho + d4);
  const slope = 2 * (half - oHalf), offset = (oModulus - modulus) * (oModulus + modulus);
  const at = real
    ? Math.abs((half < 0 ? -slope : slope) * rho + offset)
    : Math.sqrt((slope * half + offset) ** 2 + (slope * gap) ** 2);
  const disc = eps / (gap * at), lower = rho - disc, room = (lower - m) * oGap;
  // The discs of the others end below.
  let alone;
  if (oReal) {
    const turned = oHalf < 0 ? -slope : slope, small = Math.abs(oHalf) - oGap;
    alone = eps < room * Math.abs(turned * m + offset) && eps < (lower - small) * oGap * Math.abs(turned * small + offset);
  } else {
    alone = room > 0 && eps * eps < room * room * ((slope * oHalf + offset) ** 2 + (slope * oGap) ** 2);
  }
  if (alone && real) {
    const small = Math.abs(half) - gap;
    alone = eps < (lower - small) * gap * Math.abs((half < 0 ? -slope : slope) * small + offset);
  }
  const error = alone ? disc + 4 * EPS * rho : Infinity;
  // A double multiplier cannot be bounded better than by the root of the coefficients' own errors.
  const given = ((d1 * rho + d2) * rho + d3) * rho + d4;
  out[0] = rho;
  out[1] = error;
  out[2] = (error * rho) ** 2 < 0.01 * given ? 0 : 1;
}

/** True if no polynomial within the errors has a root on the unit circle (Schur and Cohn). */
export function nothingCrosses(e1, e2, e3, logDeterminant, d1, d2, d3, d4) {
  const d = Math.exp(logDeterminant), missing = -Math.expm1(logDeterminant);
  const w = (e1 + e1 * d - 2 * e3) / missing, dw = ((1 + d) * d1 + 2 * d3) / missing;
  const rounding = 16 * EPS * (1 + Math.abs(e1) + Math.abs(e2) + Math.abs(e3) + d + e1 * e1 + w * w);
  const even = 1 + e2 + d, odd = e1 + e3, every = d1 + d2 + d3 + d4 + rounding;
  const error = d2 + d4 + ((Math.abs(e1) + d1 / 2) * d1) / 2 + ((Math.abs(w) + dw / 2) * dw) / 2 + rounding;
  const real = Math.abs(even - odd) > every && Math.abs(even + odd) > every;
  return real && Math.abs(1 + d - e2 + (e1 * e1) / 4 - (w * w) / 4) > error && missing > 0;
}

/** Verdict of a symplectic Phi whose error has at most the norm `valueError`: 0 stable, 1 unstable, 2 undecided. */
export function conservativeVerdict(phi, at, valueError) {
  const block = (k) => [phi[at + k], phi[at + k + 1], phi[at + k + 4], phi[at + k + 5]];
  const square = (x) => x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3];
  const sign = (value, error) => (value > error ? 1 : value < -error ? -1 : 0);
  const parts = [block(0), block(2), block(8), block(10)];
  const delta = valueError + 16 * EPS * Math.sqrt(parts.reduce((sum, x) => sum + square(x), 0));
  const [a, b, c, d] = parts.map((x) => sign(x[0] * x[3] - x[1] * x[2], delta * (Math.sqrt(square(x)) + delta)));
  const [, B, C] = parts;
  const m = [B[0] * C[0] + B[2] * C[2], B[0] * C[1] + B[2] * C[3], B[1] * C[0] + B[3] * C[2], B[1] * C[1] + B[3] * C[3]];
  const trace = m[0] + m[3], spread = m[0] - m[3], norm = Math.sqrt(square(m));
  const error = delta * (Math.sqrt(square(B)) + Math.sqrt(square(C)) + delta);
  const pair = sign(spread * spread + 4 * m[1] * m[2], 8 * error * (norm + error) + 32 * EPS * norm * norm);
  const inside = sign(-trace, 2 * error) * sign(2 + trace, 2 * error);
  const apart = b * c > 0 && a * d > 0 && pair > 0;
  if (apart && inside > 0) return 0;
  return b * c < 0 || a * d < 0 || pair < 0 || (apart && inside < 0) ? 1 : 2;
}
