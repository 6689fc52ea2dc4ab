// Eigenvalues of small real matrices, and the bound of their largest modulus: the algorithms of
// analysis/numerics/linear_algebra.py and analysis/floquet/multipliers.py, one matrix at a time.

export const EPS = 2 ** -52;
const MAX_SWEEPS = 60;
// Radii at which circles are tried, relative to the spectral radius: four a decade, a little below powers of ten.
const LADDER = Float64Array.from({ length: 69 }, (_, k) => 0.99 * 10 ** ((k - 64) / 4));

/** Product of `n` x `n` matrices, row by row. */
export function product(a, b, n) {
  const c = new Float64Array(n * n);
  for (let i = 0; i < n; i++)
    for (let k = 0; k < n; k++) {
      const w = a[i * n + k];
      for (let j = 0; j < n; j++) c[i * n + j] += w * b[k * n + j];
    }
  return c;
}

/** Coefficients a_1 .. a_n of det(s I - Z), by the recursion of Faddeev and Le Verrier; sizes of their derivatives into `slopes`. */
export function characteristic(z, n, slopes) {
  let power = z;
  const found = new Float64Array(n);
  slopes[0] = Math.sqrt(n);
  for (let k = 1; k <= n; k++) {
    let trace = 0;
    for (let i = 0; i < n; i++) trace += power[i * n + i];
    const a = -trace / k;
    found[k - 1] = a;
    if (k < n) {
      slopes[k] = Math.sqrt(power.reduce((sum, v, i) => sum + (v + (i % (n + 1) ? 0 : a)) ** 2, 0));
      power = product(z, power, n);
      for (let i = 0; i < n * n; i++) power[i] += a * z[i];
    }
  }
  return found;
}

/** Upper Hessenberg matrix similar to `a`, by Householder reflections. */
function hessenberg(a, n) {
  const h = Float64Array.from(a);
  for (let k = 0; k < n - 2; k++) {
    const v = new Float64Array(n);
    let norm = 0;
    for (let i = k + 1; i < n; i++) norm += h[i * n + k] ** 2;
    norm = Math.sqrt(norm);
    for (let i = k + 1; i < n; i++) v[i] = h[i * n + k];
    v[k + 1] += v[k + 1] < 0 ? -norm : norm;
    let size = 0;
    for (let i = k + 1; i < n; i++) size += v[i] ** 2;
    if (!(size > 0)) continue;
    for (let j = 0; j < n; j++) {
      let s = 0;
      for (let i = k + 1; i < n; i++) s += v[i] * h[i * n + j];
      for (let i = k + 1; i < n; i++) h[i * n + j] -= ((2 * s) / size) * v[i];
    }
    for (let i = 0; i < n; i++) {
      let s = 0;
      for (let j = k + 1; j < n; j++) s += h[i * n + j] * v[j];
      for (let j = k + 1; j < n; j++) h[i * n + j] -= ((2 * s) / size) * v[j];
    }
  }
  return h;
}

function complexRoot(x, y) {
  const modulus = Math.hypot(x, y);
  const real = Math.sqrt((modulus + Math.abs(x)) / 2);
  const other = real > 0 ? Math.abs(y) / (2 * real) : 0;
  const sign = y < 0 ? -1 : 1;
  return x >= 0 ? [real, sign * other] : [other, sign * real];
}

/** Eigenvalues of the complex [[a, b], [c, d]], the second nearer to d: [re, im, re, im]. */
function pair(ar, ai, br, bi, cr, ci, dr, di) {
  const hr = (ar - dr) / 2, hi = (ai - di) / 2;
  const or = br * cr - bi * ci, oi = br * ci + bi * cr;
  const [rr, ri] = complexRoot(hr * hr - hi * hi + or, 2 * hr * hi + oi);
  const sign = hr * rr + hi * ri < 0 ? -1 : 1;
  const fr = hr + sign * rr, fi = hi + sign * ri;
  // d - bc/far rather than d + half - root: no cancellation.
  const size = fr * fr + fi * fi || 1;
  return [dr + fr, di + fi, dr - (fr * or + fi * oi) / size, di - (fr * oi - fi * or) / size];
}

/** One QR step with the shift (sr, si) of the leading `m` rows of the complex Hessenberg matrix (re, im). */
function sweep(re, im, n, m, sr, si) {
  for (let i = 0; i < m; i++) (re[i * n + i] -= sr), (im[i * n + i] -= si);
  const turns = [];
  for (let k = 0; k < m - 1; k++) {
    const p = k * n, q = p + n;
    const norm = Math.sqrt(re[p + k] ** 2 + im[p + k] ** 2 + re[q + k] ** 2 + im[q + k] ** 2);
    const [cr, ci, dr, di] = norm > 0 ? [re[p + k], im[p + k], re[q + k], im[q + k]].map((x) => x / norm) : [1, 0, 0, 0];
    turns.push([cr, ci, dr, di]);
    for (let j = k; j < n; j++) {
      const xr = re[p + j], xi = im[p + j], yr = re[q + j], yi = im[q + j];
      re[p + j] = cr * xr + ci * xi + dr * yr + di * yi;
      im[p + j] = cr * xi - ci * xr + dr * yi - di * yr;
      re[q + j] = cr * yr - ci * yi - (dr * xr - di * xi);
      im[q + j] = cr * yi + ci * yr - (dr * xi + di * xr);
    }
  }
  turns.forEach(([cr, ci, dr, di], k) => {
    for (let i = 0; i < Math.min(k + 2, m); i++) {
      const a = i * n + k, b = a + 1;
      const xr = re[a], xi = im[a], yr = re[b], yi = im[b];
      re[a] = xr * cr - xi * ci + (yr * dr - yi * di);
      im[a] = xr * ci + xi * cr + (yr * di + yi * dr);
      re[b] = cr * yr + ci * yi - (dr * xr + di * xi);
      im[b] = cr * yi - ci * yr - (dr * xi - di * xr);
    }
  });
  for (let i = 0; i < m; i++) (re[i * n + i] += sr), (im[i * n + i] += si);
}

/** Real and imaginary parts of the eigenvalues of the real matrix `a`. */
export function eigenvalues(a, n) {
  if (n === 1) return [Float64Array.of(a[0]), new Float64Array(1)];
  const re = hessenberg(a, n), im = new Float64Array(n * n);
  if (!re.every(Number.isFinite)) return [new Float64Array(n).fill(NaN), new Float64Array(n).fill(NaN)];
  const size = (i) => Math.abs(re[i]) + Math.abs(im[i]);
  const corner = (m) => {
    const p = (m - 2) * n + m - 2, q = p + n;
    return pair(re[p], im[p], re[p + 1], im[p + 1], re[q], im[q], re[q + 1], im[q + 1]);
  };
  for (let m = n; m > 2; m--) {
    for (let count = 0; count < MAX_SWEEPS; count++) {
      const last = (m - 1) * n + m - 1, coupling = size(last - 1);
      if (!(coupling > EPS * (size(last) + size(last - n - 1)))) break;
      const [, , sr, si] = corner(m);
      // Every tenth sweep an arbitrary shift breaks a cycle.
      const kick = count % 10 === 9 ? 0.75 * coupling : 0;
      sweep(re, im, n, m, sr + kick, si - kick / 2);
    }
  }
  const x = new Float64Array(n), y = new Float64Array(n);
  for (let i = 2; i < n; i++) (x[i] = re[i * n + i]), (y[i] = im[i * n + i]);
  [x[0], y[0], x[1], y[1]] = corner(2);
  return [x, y];
}

/** True if all multipliers without damping are simple and on the unit circle; `error` is that of a_k in units of rho^k. */
export function allOnCircle(re, im, error) {
  const moduli = Array.from(re, (x, i) => Math.hypot(x, im[i])), rho = Math.max(...moduli);
  const gap = (i, j) => Math.hypot(re[i] - re[j], im[i] - im[j]);
  const radii = moduli.map((modulus, i) => {
    const holds = (r) => {
      let all = 1, eps = 0;
      for (let j = 0; j < re.length; j++) (all *= Math.abs(gap(i, j) / rho - r)), (eps = eps * (modulus / rho + r) + error);
      return all > eps;
    };
    return rho * ((LADDER.find(holds) ?? Infinity) + 4 * EPS);
  });
  // Four radii about a multiplier at the unit circle contain the reflection of its circle if that is below 0.1.
  const apart = (i) => radii.every((radius, j) => i === j || gap(i, j) > 4 * radii[i] + radius);
  return moduli.every((modulus, i) => radii[i] < 0.1 && Math.abs(modulus - 1) <= radii[i] && apart(i));
}

/** Bound of the error of the largest modulus of the multipliers; `error` is that of a_k in units of rho^k. */
export function radiusBound(re, im, error) {
  const n = re.length, moduli = re.map((x, i) => Math.hypot(x, im[i]));
  const rho = Math.max(...moduli);
  if (!(rho > 0)) return rho === 0 ? Infinity : NaN;
  const x = re.map((v) => v / rho), y = im.map((v) => v / rho), m = moduli.map((v) => v / rho);
  const eps = (r) => n * error * (1 + r) ** (n - 1);
  const gap = (i, j) => Math.hypot(x[i] - x[j], y[i] - y[j]);
  const closest = Float64Array.from(m, (_, i) => {
    let least = Infinity;
    for (let j = 0; j < n; j++) if (j !== i) least = Math.min(least, gap(i, j));
    return least;
  });
  // No zero leaves |z| <= 1 + r.
  const around = (r) => {
    let least = Infinity;
    for (let i = 0; i < n; i++) {
      const reach = 1 + r - m[i];
      let all = reach;
      for (let j = 0; j < n; j++)
        if (j !== i) all *= Math.max(1 + r - m[j], reach < closest[i] / 32 ? gap(i, j) - reach : gap(i, j) / 2);
      least = Math.min(least, all);
    }
    return least > eps(r);
  };
  // A zero stays within r of the largest multiplier.
  const top = m.indexOf(Math.max(...m));
  const near = (r) => {
    let all = 1;
    for (let j = 0; j < n; j++) all *= Math.abs(gap(top, j) - r);
    return all > eps(r);
  };
  const radius = Math.max(LADDER.find(around) ?? Infinity, LADDER.find(near) ?? Infinity);
  return rho * (radius + 4 * EPS);
}
