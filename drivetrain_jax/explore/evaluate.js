// An atlas as a function: panels, points, slices. Python: atlas/panels.py, atlas/stability.py.
import { EPS, allOnCircle, characteristic, eigenvalues, product, radiusBound } from "./linear.js";
import { conservativeVerdict, invariants, nothingCrosses, radius } from "./quartic.js";

// Relative tolerance for points outside a box by rounding of their coordinate.
const SLACK = 8 * EPS;
export const STABLE = 0, UNSTABLE = 1, UNDECIDED = 2, GAP = 3;
const FORMS = {
  "x": (x) => x,
  "1/x": (x) => 1 / x,
  "1/sqrt(x)": (x) => 1 / Math.sqrt(x),
  "sqrt(x)": Math.sqrt,
  "x^2": (x) => x * x,
  "ln(x)": Math.log,
  "ln sec(x)": (x) => -Math.log1p(-2 * Math.sin(x / 2) ** 2),
};

/** Bytes from base64. */
function bytesOf(text) {
  const letters = atob(text), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

/** Float64Array from base64. */
export const decode = (text) => new Float64Array(bytesOf(text).buffer);

/** Places along each coordinate of the coefficients whose bits, from number `first` on, are set. */
function keptPlaces(bits, first, degrees) {
  const count = degrees.reduce((a, b) => a * b, 1), index = [];
  for (let i = 0; i < count; i++) if (bits[(first + i) >> 3] & (128 >> ((first + i) & 7))) index.push(i);
  const places = degrees.map(() => new Int32Array(index.length));
  for (let k = degrees.length - 1, step = 1; k >= 0; step *= degrees[k--])
    for (let i = 0; i < index.length; i++) places[k][i] = Math.floor(index[i] / step) % degrees[k];
  return { count, places };
}

/** The atlas of the page's data (explore/__init__.py). */
export function openAtlas(data) {
  const m = data.size * data.size, all = decode(data.coefficients), bits = bytesOf(data.kept);
  let bit = 0, used = 0;
  const panels = data.panels.map((panel) => {
    const { count, places } = keptPlaces(bits, bit, panel.degrees);
    const coefficients = all.subarray(used * m, (used += places[0].length) * m);
    bit += count;
    const log = panel.log && { ...panel.log, coefficients: decode(panel.log.coefficients) };
    return { ...panel, coefficients, places, log };
  });
  return { ...data, panels, forward: data.parameters.map((p) => FORMS[p.form]) };
}

export const between = (box, k, x) =>
  x >= box.lower[k] - SLACK * Math.max(Math.abs(box.lower[k]), Math.abs(box.upper[k])) &&
  x <= box.upper[k] + SLACK * Math.max(Math.abs(box.lower[k]), Math.abs(box.upper[k]));

/** Position of `x` in [-1, 1] along the coordinate k of a box. */
export function position(box, k, x) {
  const t = (x - box.lower[k] - (box.upper[k] - x)) / (box.upper[k] - box.lower[k]);
  return Math.min(Math.max(t, -1), 1);
}

/** T_0 .. T_(n-1) at `t`. */
export function chebyshev(t, n) {
  const angle = Math.acos(t), found = new Float64Array(n);
  for (let j = 0; j < n; j++) found[j] = Math.cos(j * angle);
  return found;
}

/** out[c] = sum_n weights[at + n] source[from + n length + c] for the `length` first c, eight sums at a time in registers. */
export function combine(source, from, length, weights, at, n, out) {
  let c = 0;
  for (; c + 8 <= length; c += 8) {
    let s0 = 0, s1 = 0, s2 = 0, s3 = 0, s4 = 0, s5 = 0, s6 = 0, s7 = 0;
    for (let j = 0, o = from + c; j < n; j++, o += length) {
      const w = weights[at + j];
      s0 += w * source[o];
      s1 += w * source[o + 1];
      s2 += w * source[o + 2];
      s3 += w * source[o + 3];
      s4 += w * source[o + 4];
      s5 += w * source[o + 5];
      s6 += w * source[o + 6];
      s7 += w * source[o + 7];
    }
    out[c] = s0;
    out[c + 1] = s1;
    out[c + 2] = s2;
    out[c + 3] = s3;
    out[c + 4] = s4;
    out[c + 5] = s5;
    out[c + 6] = s6;
    out[c + 7] = s7;
  }
  for (; c < length; c++) {
    let sum = 0;
    for (let j = 0, o = from + c; j < n; j++, o += length) sum += weights[at + j] * source[o];
    out[c] = sum;
  }
}

/** Sum of a dense tensor over all coordinates but those in `axes`, whose order the result has. */
function contractDense(coefficients, degrees, weights, axes) {
  const shape = axes.map((k) => degrees[k]), out = new Float64Array(shape.reduce((a, b) => a * b, 1));
  for (let i = 0; i < coefficients.length; i++) {
    let w = coefficients[i], rest = i;
    const place = degrees.map(() => 0);
    for (let k = degrees.length - 1; k >= 0; k--) (place[k] = rest % degrees[k]), (rest = Math.floor(rest / degrees[k]));
    place.forEach((j, k) => axes.includes(k) || (w *= weights[k][j]));
    out[axes.reduce((at, k) => at * degrees[k] + place[k], 0)] += w;
  }
  return out;
}

/** A panel over the coordinates `axes` only, at the positions `t` of the others. */
function contract(panel, t, axes, m) {
  const others = panel.degrees.map((_, k) => k).filter((k) => !axes.includes(k));
  const weights = panel.degrees.map((n, k) => (axes.includes(k) ? null : chebyshev(t[k], n)));
  const degrees = axes.map((k) => panel.degrees[k]);
  const tensor = new Float64Array(degrees.reduce((a, b) => a * b, 1) * m), c = panel.coefficients;
  for (let i = 0, at = 0; at < c.length; i++) {
    let w = 1, to = 0;
    for (let k = 0; k < others.length; k++) w *= weights[others[k]][panel.places[others[k]][i]];
    for (let k = 0; k < axes.length; k++) to = to * degrees[k] + panel.places[axes[k]][i];
    to *= m;
    for (let e = 0; e < m; e++, at++) tensor[to + e] += w * c[at];
  }
  const log = panel.log && contractLog(panel.log, t, axes);
  const [lower, upper] = [panel.lower, panel.upper].map((x) => axes.map((k) => x[k]));
  return { ...panel, lower, upper, degrees, tensor, log };
}

function contractLog(log, t, axes) {
  const weights = log.degrees.map((n, k) => (axes.includes(k) ? null : chebyshev(t[k], n)));
  const coefficients = contractDense(log.coefficients, log.degrees, weights, axes);
  return { error: log.error, degrees: axes.map((k) => log.degrees[k]), coefficients };
}

/** Coordinates of `values`, a number for each parameter. */
const coordinates = (atlas, values) => atlas.forward.map((f, k) => f(values[k]));

/** The atlas over the parameters `axes` (numbers, slowest first); `values` are those of all parameters. */
export function slice(atlas, values, axes) {
  const x = coordinates(atlas, values);
  const others = atlas.parameters.map((_, k) => k).filter((k) => !axes.includes(k));
  const panels = atlas.panels
    .filter((panel) => others.every((k) => between(panel, k, x[k])))
    .map((panel) => contract(panel, x.map((v, k) => position(panel, k, v)), axes, atlas.size * atlas.size));
  return { atlas, axes, values: Float64Array.from(values), panels, forward: axes.map((k) => atlas.forward[k]) };
}

/** True if the system is Hamiltonian at `values`. */
export function isHamiltonian(atlas, values) {
  return atlas.hamiltonian === true || (atlas.hamiltonian || []).some(([k, value]) => values[k] === value);
}

/** Results of `phi` by the eigenvalues of Z. */
function byEigenvalues(atlas, panel, phi, log, hamiltonian) {
  const n = atlas.size;
  let z = phi;
  if (atlas.reversor) {
    const turned = new Float64Array(n * n), x = Float64Array.from(atlas.reversor);
    for (let i = 0; i < n; i++) for (let j = 0; j < n; j++) turned[i * n + j] = phi[j * n + i];
    z = product(product(x, product(turned, x, n), n), phi, n);
  }
  const slopes = new Float64Array(n), a = characteristic(z, n, slopes), [re, im] = eigenvalues(z, n);
  const rho = Math.max(...re.map((v, i) => Math.hypot(v, im[i])));
  const square = phi.reduce((sum, v) => sum + v * v, 0), error = panel.value_error;
  const changed = atlas.halves === 1 ? error : (2 * Math.sqrt(square) + error) * error;
  let relative = 0;
  // The exact determinant has no error.
  for (let k = 0; k < (log === null ? n : n - 1); k++) relative = Math.max(relative, (slopes[k] * changed) / rho ** (k + 1));
  if (log !== null) relative = Math.max(relative, Math.abs(((-1) ** n * a[n - 1] - Math.exp(log)) / rho ** n));
  relative += (8 * EPS * square ** (atlas.halves / 2)) / rho;
  // Bounded motion without damping: all multipliers lie on the unit circle.
  if (hamiltonian && allOnCircle(re, im, relative)) return { spectral_radius: 1, spectral_radius_error: 4 * EPS, verdict: STABLE };
  const bound = radiusBound(re, im, relative);
  return { spectral_radius: rho, spectral_radius_error: bound, verdict: decide(rho, bound) };
}

const decide = (rho, error) => (rho + error < 1 ? STABLE : rho - error > 1 ? UNSTABLE : UNDECIDED);

const work = new Float64Array(9), three = new Float64Array(3);

/** Relative error of exp(log). */
export const determinantError = (log, error) => 8 * EPS * (1 + Math.abs(log)) + error;

/** Results from Phi (n x n entries by rows) and log det Z at one point of a panel. */
export function judge(atlas, panel, phi, log, hamiltonian) {
  if (!atlas.closed_form) return byEigenvalues(atlas, panel, phi, log, hamiltonian);
  invariants(phi, 0, work, panel.value_error);
  const [e1, e2, e3] = work;
  const d = [work[3] + work[6], work[4] + work[7], work[5] + work[8], determinantError(log, panel.log.error) * Math.exp(log)];
  radius(e1, e2, e3, Math.exp(log / 4), ...d, three);
  let [rho, error, wide] = three, verdict = decide(rho, error);
  if ((wide && error > 4 * EPS) || !(Math.abs(rho - 1) > error)) {
    const better = byEigenvalues(atlas, panel, phi, log, hamiltonian);
    ({ spectral_radius: rho, spectral_radius_error: error, verdict } = better);
    if (verdict === UNDECIDED && nothingCrosses(e1, e2, e3, log, ...d)) verdict = rho < 1 ? STABLE : UNSTABLE;
  }
  if (hamiltonian && atlas.symplectic) {
    verdict = conservativeVerdict(phi, 0, panel.value_error);
    // Bounded motion without damping: all multipliers lie on the unit circle.
    if (verdict === STABLE) [rho, error] = [1, 4 * EPS];
  }
  return { spectral_radius: rho, spectral_radius_error: error, verdict };
}

const nothing = () => ({ spectral_radius: NaN, spectral_radius_error: NaN, verdict: UNDECIDED, covered: false });

/** Results at coordinates `x` of a slice; `values` are those of all parameters. */
function atCoordinates(part, x, values) {
  const { atlas } = part, m = atlas.size * atlas.size;
  const panel = part.panels.find((p) => x.every((v, k) => between(p, k, v)));
  if (!panel) return nothing();
  let phi = panel.tensor, log = panel.log;
  const t = x.map((v, k) => position(panel, k, v));
  t.forEach((place, k) => {
    const weights = chebyshev(place, panel.degrees[k]), next = new Float64Array(phi.length / weights.length);
    combine(phi, 0, next.length, weights, 0, weights.length, next);
    phi = next;
  });
  if (log) log = contractLog(log, t, []).coefficients[0];
  return { ...judge(atlas, panel, phi.subarray(0, m), log ?? null, isHamiltonian(atlas, values)), covered: true };
}

/** Results at a point of a slice: a value for each of its axes. */
export function atPoint(part, point) {
  const { atlas } = part, values = Array.from(part.values);
  part.axes.forEach((k, i) => (values[k] = point[i]));
  return inDomain(atlas, values) ? atCoordinates(part, coordinates(part, point), values) : nothing();
}

const inDomain = (atlas, values) => atlas.parameters.every((p, k) => values[k] >= p.lower && values[k] <= p.upper);

/** Results at `values`, an object of numbers by name; a name that is missing or unknown throws. */
export function evaluate(atlas, values) {
  const names = atlas.parameters.map((p) => p.name);
  for (const name of names)
    if (typeof values[name] !== "number") throw new Error(`${name}: missing; needed are ${names.join(", ")}`);
  for (const name of Object.keys(values))
    if (!names.includes(name)) throw new Error(`${name}: not a parameter of the atlas, which has ${names.join(", ")}`);
  const point = names.map((name) => values[name]);
  if (!inDomain(atlas, point)) return nothing();
  const x = coordinates(atlas, point);
  const panel = atlas.panels.find((p) => x.every((v, k) => between(p, k, v)));
  if (!panel) return nothing();
  const one = contract(panel, x.map((v, k) => position(panel, k, v)), [], atlas.size * atlas.size);
  const log = one.log ? one.log.coefficients[0] : null;
  return { ...judge(atlas, panel, one.tensor, log, isHamiltonian(atlas, point)), covered: true };
}
