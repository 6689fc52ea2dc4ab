// Contents of a chart as numbers: colours of cells, boundaries as curves, predicted resonances, ticks. No DOM.
import { GAP, STABLE, UNDECIDED, UNSTABLE, chebyshev, decode } from "./evaluate.js";

export const THEMES = {
  light: {
    paper: "#ffffff", ink: "#1b1f24", muted: "#555555", accent: "#0b6cb8", prediction: "#0b84d8", boundary: "#000000", band: "rgba(11,132,216,.16)",
    verdicts: [[255, 255, 255], [51, 65, 92], [242, 182, 50], [214, 214, 214]], stripe: [150, 150, 150],
    decay: [[208, 224, 239], [238, 244, 249]],
  },
  dark: {
    paper: "#14171b", ink: "#e8eaed", muted: "#a5adb6", accent: "#6cbcff", prediction: "#4aa8ff", boundary: "#ffffff", band: "rgba(108,188,255,.2)",
    verdicts: [[32, 38, 46], [143, 168, 216], [242, 182, 50], [72, 72, 72]], stripe: [130, 130, 130],
    decay: [[44, 58, 72], [26, 32, 40]],
  },
};
const GROWTH = [[0.25, [243, 181, 98]], [0.55, [200, 85, 61]], [1, [45, 10, 43]]];
// log10(rho) below which the scale of growth is linear: narrow tongues differ from 1 by 1e-5 and less.
const LINEAR = 1e-5;
// Width of the stripes of cells without a panel, in cells.
const STRIPE = 4;

const blend = (a, b, part) => a.map((x, i) => x + (b[i] - x) * part);
const squeezed = (size, most) => Math.log1p(size / LINEAR) / Math.log1p(Math.max(most, LINEAR) / LINEAR);

/** The colour of log10(rho) between the extremes `low` < 0 < `high` of the chart. */
export function growthColour(value, low, high, theme) {
  const [neutral, decay] = theme.decay;
  if (value <= 0) return blend(neutral, decay, Math.min(squeezed(-value, -low), 1));
  const part = Math.min(squeezed(value, high), 1), stops = [[0, neutral], ...GROWTH];
  const k = Math.max(stops.findIndex(([at]) => part <= at), 1);
  const [[from, a], [to, b]] = [stops[k - 1], stops[k]];
  return blend(a, b, (part - from) / (to - from));
}

/** Extremes of log10(rho) of a grid: at most 0 and at least 0. */
export function extremes(grid) {
  let low = 0, high = 0;
  for (const rho of grid.rho) {
    const value = Math.log10(rho);
    if (value < low && value > -Infinity) low = value;
    if (value > high && value < Infinity) high = value;
  }
  return { low, high };
}

/** RGBA of the cells of a grid, the last row on top; `map` is "verdict" or "growth". */
export function pixels(grid, map, theme) {
  const { columns, rows, rho, verdict } = grid, image = new Uint8ClampedArray(4 * columns * rows);
  const { low, high } = map === "growth" ? extremes(grid) : {};
  const table = map === "growth" && Array.from({ length: 513 }, (_, i) => growthColour(i <= 256 ? (low * i) / 256 : scaleAt((i - 256) / 256, high), low, high, theme));
  for (let r = 0; r < rows; r++)
    for (let c = 0; c < columns; c++) {
      const cell = r * columns + c, to = 4 * ((rows - 1 - r) * columns + c);
      let colour = theme.verdicts[verdict[cell]];
      if (verdict[cell] === GAP) colour = (c + r) % (2 * STRIPE) < 2 ? theme.stripe : colour;
      else if (table) {
        const value = Math.log10(rho[cell]);
        if (value > 0) colour = table[256 + Math.round(256 * Math.min(squeezed(value, high), 1))];
        else colour = table[low < 0 ? Math.round(256 * Math.min(Math.max(value / low, 0), 1)) : 0];
      }
      image[to] = colour[0];
      image[to + 1] = colour[1];
      image[to + 2] = colour[2];
      image[to + 3] = 255;
    }
  return image;
}

/** log10(rho) at a part of the scale of growth. */
const scaleAt = (part, high) => LINEAR * Math.expm1(part * Math.log1p(Math.max(high, LINEAR) / LINEAR));

/** The boundary rho = 1 as segments [x, y, x, y, ...] in columns and rows, by marching squares. */
export function boundary(grid) {
  const { columns, rows, rho, verdict } = grid, found = [];
  const sign = (i) => (verdict[i] === STABLE ? -1 : verdict[i] === UNSTABLE ? 1 : verdict[i] === UNDECIDED ? Math.sign(rho[i] - 1) || 1 : NaN);
  const cross = (i, j) => {
    const a = Math.abs(rho[i] - 1), b = Math.abs(rho[j] - 1);
    return a + b > 0 ? a / (a + b) : 0.5;
  };
  for (let r = 0; r + 1 < rows; r++)
    for (let c = 0; c + 1 < columns; c++) {
      const at = [r * columns + c, r * columns + c + 1, (r + 1) * columns + c + 1, (r + 1) * columns + c];
      const signs = at.map(sign), sum = signs[0] + signs[1] + signs[2] + signs[3];
      if (Number.isNaN(sum) || Math.abs(sum) === 4) continue;
      const points = [];
      for (let k = 0; k < 4; k++) {
        const j = (k + 1) % 4;
        if (signs[k] === signs[j]) continue;
        const part = cross(at[k], at[j]);
        const from = [c + (k === 1 || k === 2), r + (k > 1)], to = [c + (j === 1 || j === 2), r + (j > 1)];
        points.push(from[0] + part * (to[0] - from[0]), from[1] + part * (to[1] - from[1]));
      }
      found.push(...points);
    }
  return found;
}

/** A function of the values of all parameters: predicted positions along the axis, by label. */
export function resonances(atlas) {
  const told = atlas.resonances;
  if (!told) return () => [];
  const coefficients = decode(told.coefficients), count = told.labels.length;
  return (values) => {
    let part = coefficients;
    told.parameters.forEach((k, i) => {
      const x = atlas.forward[k](values[k]), span = told.upper[i] - told.lower[i];
      const t = Math.min(Math.max((x - told.lower[i] - (told.upper[i] - x)) / span, -1), 1);
      const weights = chebyshev(t, told.degrees[i]), length = part.length / weights.length;
      part = Float64Array.from({ length }, (_, e) => weights.reduce((sum, w, j) => sum + w * part[j * length + e], 0));
    });
    return Array.from({ length: count }, (_, i) => ({ label: told.labels[i], line: told.lines[i], value: part[i] })).filter((x) => x.line);
  };
}

/** Round numbers between `low` and `high`, about `count` of them and at least three. */
export function ticks(low, high, count) {
  const raw = (high - low) / Math.max(count, 1), power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((f) => f * power).find((s) => s >= raw * 0.999);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) found.push(i * step);
  if (found.length < 3 && count < 9) return ticks(low, high, count + 1);
  return { step, values: found };
}

/** A tick as text, with the decimals of its step. */
export function tickText(value, step) {
  const decimals = Math.max(0, Math.min(12, -Math.floor(Math.log10(step) + 1e-9) + (Math.abs(step / 10 ** Math.floor(Math.log10(step)) - 2.5) < 1e-6)));
  return Math.abs(value) >= 1e6 ? value.toExponential(2) : value.toFixed(decimals);
}
