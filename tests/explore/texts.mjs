// Runs the modules without a document: marks, texts, colours. Prints JSON.
import fs from "node:fs";
import { THEMES, boundary, growthColour, pixels, resonances, tickText, ticks } from "../../drivetrain_jax/explore/chart.js";
import { openAtlas, slice } from "../../drivetrain_jax/explore/evaluate.js";
import { onGrid } from "../../drivetrain_jax/explore/grid.js";
import { marks, svg } from "../../drivetrain_jax/explore/marks.js";
import { commandText, csvText, fromHash, labelText, sceneText, shown, toHash, unitOf } from "../../drivetrain_jax/explore/text.js";

const text = fs.readFileSync(process.argv[2], "utf8"), json = /<script type="application\/json" id="data">([^]*?)<\/script>/.exec(text)[1];
const atlas = openAtlas(JSON.parse(json)), hash = process.argv[3] || "", n = 201;
const state = fromHash(atlas, hash), values = state.panes[0].values;
const spaced = (k) => Float64Array.from({ length: n }, (_, i) => state.lower[k] + ((state.upper[k] - state.lower[k]) * i) / (n - 1));
const [ys, xs] = state.axes.map(spaced), grid = onGrid(slice(atlas, values, state.axes), xs, ys);
const image = pixels(grid, "verdict", THEMES.light), growth = pixels(grid, "growth", THEMES.dark);
const label = '<script>alert("x")</script>', axis = { factor: 1, lower: 0, upper: 1, label };
const list = marks({ axes: [axis, axis], segments: [0, 0, 1, 1], lines: [], bands: [], curve: null }, 600, 400, "light");
process.stdout.write(JSON.stringify({
  seen: atlas.parameters.map((p) => unitOf(p, state.units)),
  fixed: Object.values(atlas.fixed),
  state: { ...state, hash: toHash(atlas, state) },
  scene: sceneText(atlas, { axes: state.axes, values, lower: state.lower, upper: state.upper, units: state.units }, 5),
  command: commandText(atlas, values, state.units),
  csv: csvText(onGrid(slice(atlas, values, state.axes), xs.slice(0, 2), ys.slice(0, 2)), state.axes.map((k) => atlas.parameters[k].name), xs, ys).split("\n"),
  boundary: boundary(grid).map((v, i) => (i % 2 ? ys : xs)[0] + (v * ((i % 2 ? ys : xs)[n - 1] - (i % 2 ? ys : xs)[0])) / (n - 1)),
  corner: [...image.slice(0, 4)], bottom: [...image.slice(-4 * n, -4 * n + 4)], dark: growth.length,
  neutral: growthColour(0, -1, 1, THEMES.light), most: growthColour(1, -1, 1, THEMES.light),
  resonances: resonances(atlas)(values),
  svg: svg(list, 600, 400, "data:image/png;base64,"),
  ticks: ticks(0.1, 2, 8).values.map((v) => tickText(v, ticks(0.1, 2, 8).step)),
  words: [labelText("H12"), labelText("C+1"), labelText("odd"), shown(1 / 3), shown(NaN)],
}));
