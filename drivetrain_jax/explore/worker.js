// Answers of an atlas to messages. The page runs this in Web Workers, or calls `answer` itself where it may have none.
import { atPoint, openAtlas, slice } from "./evaluate.js";
import { onGrid, onLine } from "./grid.js";

/** Rows `first` to `last` of a chart, or a line: `axes` are the parameters of rows and columns, or of the line alone. */
export function answer(atlas, { values, axes, xs, ys, distances }) {
  if (distances) return nearest(atlas, values);
  const part = slice(atlas, values, axes);
  return axes.length > 1 ? onGrid(part, xs, ys) : onLine(part, xs);
}

// Values of a parameter at which a line is looked at, and steps of bisection.
const SAMPLES = 600, STEPS = 50;

/** The nearest change of the verdict below and above `values` along each parameter, NaN without one. */
export function nearest(atlas, values) {
  return atlas.parameters.map((parameter, k) => {
    const part = slice(atlas, values, [k]), here = values[k];
    const at = (value) => atPoint(part, [value]).verdict;
    const search = (end) => {
      let before = here, verdict = at(here);
      const count = Math.ceil((SAMPLES * Math.abs(end - here)) / (parameter.upper - parameter.lower));
      for (let i = 1; i <= count; i++) {
        const next = i === count ? end : here + ((end - here) * i) / count, now = at(next);
        if (now < 2 && verdict < 2 && now !== verdict) return bisect(at, before, next, verdict);
        if (now < 2) [before, verdict] = [next, now];
      }
      return NaN;
    };
    return { name: parameter.name, below: search(parameter.lower), above: search(parameter.upper) };
  });
}

function bisect(at, a, b, verdict) {
  for (let i = 0; i < STEPS && a !== b; i++) {
    const middle = (a + b) / 2;
    if (at(middle) === verdict) a = middle;
    else b = middle;
  }
  return (a + b) / 2;
}

if (typeof WorkerGlobalScope !== "undefined") {
  let atlas = null;
  self.onmessage = ({ data }) => {
    if (data.open) atlas = openAtlas(data.open);
    else {
      const found = answer(atlas, data.question);
      const buffers = [found.rho, found.error, found.verdict].filter(Boolean).map((array) => array.buffer);
      self.postMessage({ id: data.id, found }, buffers);
    }
  };
}
