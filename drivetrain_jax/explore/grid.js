// A slice of an atlas on a grid. As in Python (atlas/tiles.py, atlas/charts.py), the coefficients e1, e2, e3 of the
// characteristic polynomial are computed at Chebyshev nodes of small boxes, and interpolated from there to the cells.
import {
  GAP, STABLE, UNDECIDED, UNSTABLE, atPoint, between, chebyshev, determinantError, isHamiltonian, position,
} from "./evaluate.js";
import { EPS } from "./linear.js";
import { invariants, radius } from "./quartic.js";

// Nodes of a box, and its largest angle arccos(t) times the degree of the panel.
const NODES = 24, SPAN = 11;
// Cells from which on nodes cost less than the cells themselves; factor by which interpolation may amplify rounding.
const FEWEST = 36, SPREAD = 4;

const nodes = Float64Array.from({ length: NODES }, (_, i) => Math.cos((Math.PI * (i + 0.5)) / NODES));
// From values at the nodes to Chebyshev coefficients, row by row.
const analysis = Array.from({ length: NODES }, (_, k) =>
  Float64Array.from({ length: NODES }, (_, i) => {
    const quarters = (k * (2 * i + 1)) % (4 * NODES);
    return ((k ? 2 : 1) / NODES) * Math.cos((Math.PI / (2 * NODES)) * quarters);
  }),
);

/** Weights (NODES) that interpolate from the nodes to the place y in [-1, 1]. */
function spreadTo(y) {
  const t = chebyshev(y, NODES), weights = new Float64Array(NODES);
  for (let k = 0; k < NODES; k++) for (let i = 0; i < NODES; i++) weights[i] += t[k] * analysis[k][i];
  return weights;
}

/** Runs of neighbouring cells along one axis of a panel: `start`, `end`, positions `t` to evaluate, `spread` to the cells. */
function pieces(panel, k, x, dense) {
  const found = [], limit = SPAN / panel.degrees[k];
  for (let start = 0; start < x.length; ) {
    if (!between(panel, k, x[start])) {
      start++;
      continue;
    }
    // A run ends where the coordinate turns round: an even one does at 0.
    const t = [position(panel, k, x[start])], direction = Math.sign(x[start + 1] - x[start]);
    let end = start + 1;
    for (; end < x.length && between(panel, k, x[end]); end++) {
      const next = position(panel, k, x[end]);
      if (Math.sign(x[end] - x[end - 1]) !== direction) break;
      if (dense && Math.abs(Math.acos(next) - Math.acos(t[0])) > limit) break;
      t.push(next);
    }
    found.push(piece(start, end, Float64Array.from(t), dense));
    start = end;
  }
  return found;
}

function piece(start, end, t, dense) {
  const count = end - start, low = Math.min(t[0], t[count - 1]), high = Math.max(t[0], t[count - 1]);
  if (!dense || count < FEWEST || !(high > low)) return { start, end, t, spread: null };
  const spread = new Float64Array(count * NODES);
  t.forEach((v, i) => spread.set(spreadTo(Math.min(Math.max((v - low - (high - v)) / (high - low), -1), 1)), i * NODES));
  return { start, end, t: nodes.map((v) => Math.min(Math.max((low * (1 - v) + high * (1 + v)) / 2, -1), 1)), spread };
}

/** T_j at positions, (positions, n) row by row. */
function table(t, n) {
  const all = new Float64Array(t.length * n);
  t.forEach((v, i) => all.set(chebyshev(v, n), i * n));
  return all;
}

/** Twice the last three Chebyshev coefficients of values at the nodes: a bound of what interpolation leaves out. */
function leftOut(values, at, step) {
  let sum = 0;
  for (let k = NODES - 3; k < NODES; k++) {
    let c = 0;
    for (let i = 0; i < NODES; i++) c += analysis[k][i] * values[at + i * step];
    sum += Math.abs(c);
  }
  return 2 * sum;
}

/** The tensor of a panel contracted over its rows: (columns' degree) x m into `out`. */
function contractRow(tensor, weights, at, n, length, out) {
  out.fill(0);
  for (let i = 0; i < n; i++) {
    const w = weights[at + i], from = i * length;
    for (let j = 0; j < length; j++) out[j] += w * tensor[from + j];
  }
}

/** Phi, 16 entries, from a contracted row and T_j at one column. */
function phiAt(row, weights, at, n, phi) {
  let a = 0, b = 0, c = 0, d = 0, e = 0, f = 0, g = 0, h = 0;
  for (let j = 0, o = 0; j < n; j++, o += 16) {
    const w = weights[at + j];
    a += w * row[o]; b += w * row[o + 1]; c += w * row[o + 2]; d += w * row[o + 3];
    e += w * row[o + 4]; f += w * row[o + 5]; g += w * row[o + 6]; h += w * row[o + 7];
  }
  phi[0] = a; phi[1] = b; phi[2] = c; phi[3] = d; phi[4] = e; phi[5] = f; phi[6] = g; phi[7] = h;
  a = b = c = d = e = f = g = h = 0;
  for (let j = 0, o = 8; j < n; j++, o += 16) {
    const w = weights[at + j];
    a += w * row[o]; b += w * row[o + 1]; c += w * row[o + 2]; d += w * row[o + 3];
    e += w * row[o + 4]; f += w * row[o + 5]; g += w * row[o + 6]; h += w * row[o + 7];
  }
  phi[8] = a; phi[9] = b; phi[10] = c; phi[11] = d; phi[12] = e; phi[13] = f; phi[14] = g; phi[15] = h;
}

/** Blank results of `columns` x `rows` cells: everything is a gap. */
export function blank(columns, rows) {
  const [rho, error] = [0, 1].map(() => new Float64Array(columns * rows).fill(NaN));
  return { columns, rows, rho, error, verdict: new Uint8Array(columns * rows).fill(GAP) };
}

/** Results of a slice over [row, column] on the grid of parameter values `ys` x `xs`; row 0 is ys[0]. */
export function onGrid(part, xs, ys) {
  const out = blank(xs.length, ys.length), { atlas } = part;
  const free = atlas.hamiltonian === true || (atlas.hamiltonian || []).length > 0;
  if (!atlas.closed_form || (free && mayBeHamiltonian(part, xs, ys))) {
    cellByCell(part, xs, ys, out);
    return out;
  }
  const u = Float64Array.from(xs, part.forward[1]), v = Float64Array.from(ys, part.forward[0]);
  const unsure = [];
  // Panels share faces, where the first one counts.
  for (const panel of [...part.panels].reverse()) {
    const columns = pieces(panel, 1, u, true), rows = pieces(panel, 0, v, true);
    if (columns.length) for (const band of rows) fillBand(panel, band, columns, { u, v }, out, unsure);
  }
  for (const i of unsure) store(out, i, atPoint(part, [ys[Math.floor(i / xs.length)], xs[i % xs.length]]));
  return out;
}

/** Results of a slice along one parameter. */
export function onLine(part, xs) {
  const out = blank(xs.length, 1);
  xs.forEach((x, i) => store(out, i, atPoint(part, [x])));
  return out;
}

function store(out, i, result) {
  out.rho[i] = result.spectral_radius;
  out.error[i] = result.spectral_radius_error;
  out.verdict[i] = result.covered ? result.verdict : GAP;
}

function mayBeHamiltonian(part, xs, ys) {
  const values = Array.from(part.values);
  const any = (list, k) => Array.from(list).some((v) => ((values[k] = v), isHamiltonian(part.atlas, values)));
  values[part.axes[0]] = ys[0];
  if (any(xs, part.axes[1])) return true;
  return any(ys, part.axes[0]);
}

function cellByCell(part, xs, ys, out) {
  ys.forEach((y, r) => xs.forEach((x, c) => store(out, r * xs.length + c, atPoint(part, [y, x]))));
}

/** The cells of one band of rows: first e1, e2, e3 where `band` and `columns` say, then the cells. */
function fillBand(panel, band, columns, { u, v }, out, unsure) {
  const coarse = coefficientsOf(panel, band, columns), { e, bounds, at, width } = coarse;
  const left = band.spread ? betweenRows(coarse, columns) : new Float64Array(3 * columns.length);
  const log = logDeterminants(panel, u, v, columns), line = new Float64Array(3 * width), extra = new Float64Array(3);
  const weights = new Float64Array(1).fill(1);
  for (let r = band.start; r < band.end; r++) {
    const i = r - band.start;
    const mix = band.spread ? band.spread.subarray(i * NODES, (i + 1) * NODES) : weights, first = band.spread ? 0 : i;
    combine(e, first * 3 * width, mix, line);
    columns.forEach((piece, p) => {
      for (let k = 0; k < 3; k++) {
        let sum = left[3 * p + k];
        for (let n = 0; n < mix.length; n++) sum += Math.abs(mix[n]) * bounds[((first + n) * columns.length + p) * 3 + k];
        extra[k] = sum;
      }
      fillRow(panel, piece, line, width, at[p], extra, log(r, piece), out, r, unsure);
    });
  }
}

/** Sum of rows of `rows` from `from` on with these weights, into `line`. */
function combine(rows, from, weights, line) {
  line.fill(0);
  for (let n = 0; n < weights.length; n++) {
    const w = weights[n], start = from + n * line.length;
    for (let c = 0; c < line.length; c++) line[c] += w * rows[start + c];
  }
}

/**
 * `e` (rows, 3, width): e1, e2, e3 at the places of a band and of all columns, which begin `at` each piece;
 * `bounds` (rows, pieces, 3): what rounding and interpolation along the columns add to their errors.
 */
function coefficientsOf(panel, band, columns) {
  const [ny, nx] = panel.degrees, weightsY = table(band.t, ny), at = [];
  let width = 0;
  for (const piece of columns) at.push(width), (width += piece.t.length);
  const weightsX = new Float64Array(width * nx);
  columns.forEach((piece, p) => weightsX.set(table(piece.t, nx), at[p] * nx));
  const e = new Float64Array(band.t.length * 3 * width), bounds = new Float64Array(band.t.length * 3 * columns.length);
  const row = new Float64Array(nx * 16), phi = new Float64Array(16), work = new Float64Array(6);
  const rounding = new Float64Array(3 * width);
  for (let i = 0, o = 0, b = 0; i < band.t.length; i++, o += 3 * width) {
    contractRow(panel.tensor, weightsY, i * ny, ny, nx * 16, row);
    for (let c = 0; c < width; c++) {
      phiAt(row, weightsX, c * nx, nx, phi);
      invariants(phi, 0, work);
      for (let k = 0, q = c; k < 3; k++, q += width) (e[o + q] = work[k]), (rounding[q] = work[3 + k]);
    }
    for (let p = 0; p < columns.length; p++)
      for (let k = 0; k < 3; k++, b++) bounds[b] = boundOf(columns[p], rounding, e, k * width + at[p], o);
  }
  return { e, bounds, at, width };
}

function boundOf(piece, rounding, e, from, row) {
  let most = 0;
  // Without nodes every cell has its own rounding; the largest one serves for all of them.
  for (let c = from; c < from + piece.t.length; c++) most = Math.max(most, rounding[c]);
  return piece.spread ? SPREAD * most + leftOut(e, row + from, 1) : most;
}

/** What interpolation between the rows of a band leaves out in each piece, (pieces, 3). */
function betweenRows({ e, at, width }, columns) {
  const found = new Float64Array(3 * columns.length);
  columns.forEach((piece, p) => {
    for (let k = 0; k < 3; k++) {
      let most = 0;
      for (let c = 0; c < piece.t.length; c++) most = Math.max(most, leftOut(e, k * width + at[p] + c, 3 * width));
      found[3 * p + k] = piece.spread ? SPREAD * most : most;
    }
  });
  return found;
}

/** A function of a row and a piece of columns: log det Z at the cells of the piece. */
function logDeterminants(panel, u, v, columns) {
  const { degrees: [my, mx], coefficients } = panel.log;
  const tables = new Map(columns.map((piece) => [piece, table(u.subarray(piece.start, piece.end).map((x) => position(panel, 1, x)), mx)]));
  const line = new Float64Array(mx), values = new Float64Array(u.length);
  let done = -1;
  return (r, piece) => {
    if (r !== done) {
      const weights = chebyshev(position(panel, 0, v[r]), my);
      line.fill(0);
      for (let i = 0; i < my; i++) for (let j = 0; j < mx; j++) line[j] += weights[i] * coefficients[i * mx + j];
      done = r;
    }
    const weights = tables.get(piece), count = piece.end - piece.start;
    for (let c = 0, o = 0; c < count; c++) {
      let sum = 0;
      for (let j = 0; j < mx; j++, o++) sum += weights[o] * line[j];
      values[c] = sum;
    }
    return values;
  };
}

const cell3 = new Float64Array(3);

/** The cells of a row within a piece of columns. */
function fillRow(panel, piece, line, width, at, extra, log, out, r, unsure) {
  const { start, end, spread } = piece, [x1, x2, x3] = panel.derived_error;
  const d1 = x1 + extra[0], d2 = x2 + extra[1], d3 = x3 + extra[2], logError = panel.log.error;
  const two = at + width, three = two + width;
  for (let c = start; c < end; c++) {
    const i = c - start, cell = r * out.columns + c;
    let e1 = 0, e2 = 0, e3 = 0;
    if (spread) {
      for (let n = 0, o = i * NODES; n < NODES; n++, o++) {
        const w = spread[o];
        e1 += w * line[at + n];
        e2 += w * line[two + n];
        e3 += w * line[three + n];
      }
    } else (e1 = line[at + i]), (e2 = line[two + i]), (e3 = line[three + i]);
    const kappa = Math.exp(log[i] / 4), kappa2 = kappa * kappa;
    radius(e1, e2, e3, kappa, d1, d2, d3, determinantError(log[i], logError) * kappa2 * kappa2, cell3);
    const rho = cell3[0], error = cell3[1];
    out.rho[cell] = rho;
    out.error[cell] = error;
    const open = !(Math.abs(rho - 1) > error);
    out.verdict[cell] = open ? UNDECIDED : rho > 1 ? UNSTABLE : STABLE;
    if (open || (cell3[2] && error > 4 * EPS)) unsure.push(cell);
  }
}
