// A slice of an atlas on a grid. As in Python (atlas/evaluation.py, atlas/charts.py), the coefficients e1, e2, e3 of the
// characteristic polynomial are computed at Chebyshev nodes of small boxes, and interpolated from there to the cells.
import {
  GAP, STABLE, UNDECIDED, UNSTABLE, atPoint, between, chebyshev, combine, determinantError, isHamiltonian, judge,
  position,
} from "./evaluate.js";
import { EPS } from "./linear.js";
import { invariants, radius } from "./quartic.js";

// Nodes of a box, and its largest angle arccos(t) times the degree of the panel.
const NODES = 24, SPAN = 11;
// Cells from which on nodes cost less than the cells themselves; factor by which interpolation may amplify rounding.
const FEWEST = 36, SPREAD = 4;
// Ratio of the largest derivative between nodes to that at nodes.
const BETWEEN = 1.5;

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
function pieces(panel, k, x) {
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
      if (Math.abs(Math.acos(next) - Math.acos(t[0])) > limit) break;
      t.push(next);
    }
    found.push(piece(start, end, Float64Array.from(t)));
    start = end;
  }
  return found;
}

function piece(start, end, t) {
  const count = end - start, low = Math.min(t[0], t[count - 1]), high = Math.max(t[0], t[count - 1]);
  if (count < FEWEST || !(high > low)) return { start, end, t, spread: null };
  const spread = new Float64Array(count * NODES);
  t.forEach((v, i) => spread.set(spreadTo(Math.min(Math.max((v - low - (high - v)) / (high - low), -1), 1)), i * NODES));
  const places = nodes.map((v) => Math.min(Math.max((low * (1 - v) + high * (1 + v)) / 2, -1), 1));
  return { start, end, t: places, spread };
}

/** A piece whose spread begins with the cells of one node: (NODES, cells). */
const byNode = (p) => ({ ...p, spread: p.spread && turned(p.spread, p.end - p.start, NODES) });

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

/** Blank results of `columns` x `rows` cells: everything is a gap. */
export function blank(columns, rows) {
  const [rho, error] = [0, 1].map(() => new Float64Array(columns * rows).fill(NaN));
  return { columns, rows, rho, error, verdict: new Uint8Array(columns * rows).fill(GAP) };
}

/** Results of a slice over [row, column] on the grid of parameter values `ys` x `xs`; row 0 is ys[0]. */
export function onGrid(part, xs, ys) {
  const out = blank(xs.length, ys.length), { atlas } = part;
  const free = atlas.hamiltonian === true || (atlas.hamiltonian || []).length > 0;
  const u = Float64Array.from(xs, part.forward[1]), v = Float64Array.from(ys, part.forward[0]);
  const single = !atlas.closed_form || (free && mayBeHamiltonian(part, xs, ys)), unsure = [];
  // Panels share faces, where the first one counts.
  for (const panel of [...part.panels].reverse()) {
    const columns = pieces(panel, 1, u).map(byNode), rows = pieces(panel, 0, v);
    if (single) {
      for (const band of rows) for (const piece of columns) cellByCell(part, panel, band, piece, { u, v, xs, ys, out });
      continue;
    }
    for (const band of rows) fillBand(panel, band, columns, { u, v, out, unsure });
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

/** The cells of a box one by one from Phi: of systems without the closed form, or that may be Hamiltonian. */
function cellByCell(part, panel, band, piece, { u, v, xs, ys, out }) {
  const { atlas } = part, [ny, nx] = panel.degrees, m = atlas.size * atlas.size, logs = panel.log && logRows(panel, band, v);
  const t = u.subarray(piece.start, piece.end).map((x) => position(panel, 1, x)), weights = table(t, nx);
  const mx = panel.log?.degrees[1], logWeights = panel.log && table(t, mx), log = new Float64Array(1), values = Array.from(part.values);
  const row = new Float64Array(nx * m), phi = new Float64Array(m);
  for (let r = band.start; r < band.end; r++) {
    combine(panel.tensor, 0, nx * m, chebyshev(position(panel, 0, v[r]), ny), 0, ny, row);
    values[part.axes[0]] = ys[r];
    for (let c = 0; c < t.length; c++) {
      combine(row, 0, m, weights, c * nx, nx, phi);
      if (logs) combine(logWeights, c * mx, 1, logs, (r - band.start) * mx, mx, log);
      values[part.axes[1]] = xs[piece.start + c];
      const result = judge(atlas, panel, phi, logs ? log[0] : null, isHamiltonian(atlas, values));
      store(out, r * out.columns + piece.start + c, { ...result, covered: true });
    }
  }
}

/** The cells of one band of rows: panel rows first, then box by box, whose numbers stay in the cache. */
function fillBand(panel, band, columns, grid) {
  const [ny, nx] = panel.degrees, length = nx * 16, weights = table(band.t, ny);
  const rows = new Float64Array(band.t.length * length);
  for (let i = 0; i < band.t.length; i++) combine(panel.tensor, 0, length, weights, i * ny, ny, rows.subarray(i * length, (i + 1) * length));
  const logs = logRows(panel, band, grid.v);
  for (const piece of columns) fillBox(panel, band, piece, rows, logs, grid);
}

/** Rows of coefficients of log det Z along the columns, at the rows of a band. */
function logRows(panel, band, v) {
  const { degrees: [my, mx], coefficients } = panel.log, found = new Float64Array((band.end - band.start) * mx);
  for (let r = band.start, at = 0; r < band.end; r++, at += mx) {
    const weights = chebyshev(position(panel, 0, v[r]), my);
    for (let i = 0; i < my; i++) for (let j = 0; j < mx; j++) found[at + j] += weights[i] * coefficients[i * mx + j];
  }
  return found;
}

/** The cells of a box: e1, e2, e3 at the places of its band and piece, then row by row. */
function fillBox(panel, band, piece, rows, logs, grid) {
  const width = piece.t.length, count = 3 * width, { e, bounds, changes } = coefficientsOf(panel, band, piece, rows);
  const left = [0, 1, 2].map((k) => changes[k] + (band.spread ? betweenRows(e, k * width, width, piece) : 0));
  const cells = piece.end - piece.start, mx = panel.log.degrees[1], log = new Float64Array(cells);
  const tables = turned(table(grid.u.subarray(piece.start, piece.end).map((x) => position(panel, 1, x)), mx), cells, mx);
  const line = new Float64Array(count), extra = new Float64Array(3), one = new Float64Array(1).fill(1);
  const lanes = [0, 1, 2].map((k) => (piece.spread ? new Float64Array(cells) : line.subarray(k * width, (k + 1) * width)));
  for (let r = band.start, i = 0; r < band.end; r++, i++) {
    const mix = band.spread ? band.spread.subarray(i * NODES, (i + 1) * NODES) : one, first = band.spread ? 0 : i;
    combine(e, first * count, count, mix, 0, mix.length, line);
    extra.set(left);
    for (let n = 0; n < mix.length; n++) for (let k = 0; k < 3; k++) extra[k] += Math.abs(mix[n]) * bounds[(first + n) * 3 + k];
    if (piece.spread) for (let k = 0; k < 3; k++) combine(piece.spread, 0, cells, line, k * NODES, NODES, lanes[k]);
    combine(tables, 0, cells, logs, i * mx, mx, log);
    fillRow(panel, piece, lanes, log, extra, grid, r);
  }
}

/** A matrix (n, m) row by row as (m, n). */
function turned(matrix, n, m) {
  const found = new Float64Array(n * m);
  for (let i = 0; i < n; i++) for (let j = 0; j < m; j++) found[j * n + i] = matrix[i * m + j];
  return found;
}

/**
 * `e` (rows, 3, columns) at the places of a box; `bounds` (rows, 3): what rounding and the columns
 * add to their errors; `changes` (3): bounds of their changes by the error of the panel.
 */
function coefficientsOf(panel, band, piece, rows) {
  const nx = panel.degrees[1], width = piece.t.length, weights = table(piece.t, nx), count = band.t.length;
  const e = new Float64Array(count * 3 * width), bounds = new Float64Array(count * 3);
  const phi = new Float64Array(16), work = new Float64Array(9), changes = new Float64Array(3);
  for (let i = 0; i < count; i++) {
    const at = i * 3 * width;
    let r1 = 0, r2 = 0, r3 = 0;
    for (let c = 0; c < width; c++) {
      combine(rows, i * nx * 16, 16, weights, c * nx, nx, phi);
      invariants(phi, 0, work, panel.value_error);
      e[at + c] = work[0];
      e[at + width + c] = work[1];
      e[at + 2 * width + c] = work[2];
      // The largest rounding of the row serves for all of its cells.
      r1 = Math.max(r1, work[3]);
      r2 = Math.max(r2, work[4]);
      r3 = Math.max(r3, work[5]);
      for (let k = 0; k < 3; k++) changes[k] = Math.max(changes[k], work[6 + k]);
    }
    bounds.set([r1, r2, r3], 3 * i);
    if (piece.spread) for (let k = 0; k < 3; k++) bounds[3 * i + k] = SPREAD * bounds[3 * i + k] + leftOut(e, at + k * width, 1);
  }
  return { e, bounds, changes: changes.map((x) => (band.spread || piece.spread ? BETWEEN : 1) * x) };
}

/** The error of interpolation between the rows of a box. */
function betweenRows(e, at, width, piece) {
  let most = 0;
  for (let c = 0; c < width; c++) most = Math.max(most, leftOut(e, at + c, 3 * width));
  return piece.spread ? SPREAD * most : most;
}

const cell3 = new Float64Array(3);

/** The cells of a row of a box from e1, e2, e3 and log det Z there; `errors` bounds their errors. */
function fillRow(panel, { start, end }, [e1, e2, e3], log, errors, { out, unsure }, r) {
  const [d1, d2, d3] = errors, logError = panel.log.error;
  for (let i = 0, cell = r * out.columns + start; i < end - start; i++, cell++) {
    const kappa = Math.exp(log[i] / 4), kappa2 = kappa * kappa;
    radius(e1[i], e2[i], e3[i], kappa, d1, d2, d3, determinantError(log[i], logError) * kappa2 * kappa2, cell3);
    const rho = cell3[0], error = cell3[1], open = !(Math.abs(rho - 1) > error);
    out.rho[cell] = rho;
    out.error[cell] = error;
    out.verdict[cell] = open ? UNDECIDED : rho > 1 ? UNSTABLE : STABLE;
    if (open || (cell3[2] && error > 4 * EPS)) unsure.push(cell);
  }
}
