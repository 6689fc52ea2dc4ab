// Asks the modules of the page what tests want to know; prints JSON.
import fs from "node:fs";
import { evaluate, openAtlas, slice } from "../../drivetrain_jax/explore/evaluate.js";
import { onGrid } from "../../drivetrain_jax/explore/grid.js";
import { answer } from "../../drivetrain_jax/explore/worker.js";

const floats = (file) => {
  const bytes = fs.readFileSync(file);
  return new Float64Array(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
};
const spaced = (low, high, n) => Float64Array.from({ length: n }, (_, i) => low + ((high - low) * i) / (n - 1));
const write = (file, ...arrays) => fs.writeFileSync(file, Buffer.concat(arrays.map((a) => Buffer.from(Float64Array.from(a).buffer))));

const questions = {
  /** Results at points (N, d) of a file, into another file: radius, error, verdict of each. */
  points(atlas, file, out) {
    const given = floats(file), d = atlas.parameters.length, found = [];
    for (let i = 0; i < given.length; i += d) {
      const values = Object.fromEntries(atlas.parameters.map((p, k) => [p.name, given[i + k]]));
      const { spectral_radius, spectral_radius_error, verdict } = evaluate(atlas, values);
      found.push(spectral_radius, spectral_radius_error, verdict);
    }
    write(out, found);
    return found.length / 3;
  },
  /** Radius, error and verdict (3: no panel) on a grid of `n` x `n` cells over the axes `rows` and `columns`. */
  grid(atlas, rows, columns, n, out) {
    const axes = [Number(rows), Number(columns)], middle = atlas.parameters.map((p) => (p.lower + p.upper) / 2);
    const [ys, xs] = axes.map((k) => spaced(atlas.parameters[k].lower, atlas.parameters[k].upper, Number(n)));
    const grid = onGrid(slice(atlas, middle, axes), xs, ys);
    write(out, grid.rho, grid.error, grid.verdict);
    return grid.rho.length;
  },
  /** Milliseconds of a chart of `n` x `n` cells, a slider moving, and of a loop to compare machines; CPU time, the least. */
  speed(atlas, rows, columns, n, runs) {
    const axes = [Number(rows), Number(columns)];
    const [ys, xs] = axes.map((k) => spaced(atlas.parameters[k].lower, atlas.parameters[k].upper, Number(n)));
    const least = { chart: Infinity, loop: Infinity };
    const timed = (name, work) => {
      const begin = process.cpuUsage().user;
      work();
      least[name] = Math.min(least[name], (process.cpuUsage().user - begin) / 1000);
    };
    for (let i = 0; i < Number(runs); i++) {
      const at = 0.3 + (0.4 * i) / runs, values = atlas.parameters.map((p) => p.lower + at * (p.upper - p.lower));
      timed("chart", () => onGrid(slice(atlas, values, axes), xs, ys));
      timed("loop", loop);
    }
    return least;
  },
  /** Changes of the verdict nearest to the middle, along every parameter. */
  nearest: (atlas, ...values) => answer(atlas, { values: values.map(Number), distances: true }),
};

/** Products and sums over two arrays of 2 MB, 80 times: as long as a chart, and as much memory. */
const [left, right] = [new Float64Array(1 << 18).fill(0.5), new Float64Array(1 << 18).fill(0.999)];
function loop() {
  for (let k = 0; k < 80; k++) for (let i = 1; i < left.length; i++) left[i] = left[i] * right[i] + 1e-7 * left[i - 1];
}

const [page, question, ...more] = process.argv.slice(2);
const text = fs.readFileSync(page, "utf8"), json = /<script type="application\/json" id="data">([^]*?)<\/script>/.exec(text)[1];
process.stdout.write(JSON.stringify(questions[question](openAtlas(JSON.parse(json)), ...more)));
