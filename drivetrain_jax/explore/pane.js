// One chart of the page: its canvas, pointer, keys and read-out. The page's state lives in page.js, which gives `app`.
import { THEMES, boundary, pixels } from "./chart.js";
import { atPoint, slice } from "./evaluate.js";
import { barMarks, frame, marks, paint, resonancePath } from "./marks.js";
import { baseFrequency, growthPerSecond, shown, unitOf } from "./text.js";

const WORDS = ["stable", "unstable", "undecided (too close to call)"];
const create = (tag, properties = {}, ...children) => {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
};

/** The chart of `state.panes[number]`. */
export function makePane(app, number) {
  const base = create("canvas"), above = create("canvas", { className: "above" }), bar = create("canvas", { className: "bar" });
  const stack = create("div", { className: "stack", tabIndex: 0 }, base, above);
  const heading = create("h2"), map = create("select", { ariaLabel: "Map" }, new Option("verdict", "verdict"), new Option("growth", "growth"));
  const legend = create("ul", { className: "legend" }), readout = create("table", { className: "readout" });
  const live = create("p", { className: "live" });
  readout.setAttribute("aria-live", "polite");
  stack.setAttribute("role", "application");
  const node = create("article", { className: "pane" }, create("div", { className: "head" }, heading, map), stack, bar, legend, readout);
  const pane = { node, stack, base, above, bar, heading, map, legend, readout, live, number, grid: null, picture: null, part: null };
  map.addEventListener("change", () => app.change((state) => (state.panes[number].map = map.value)));
  listen(pane, app);
  return pane;
}

/** The axes of the chart, rows first; a single parameter has the spectral radius as its rows. */
function axesOf(app, pane) {
  const axes = app.state.axes.map((k) => {
    const parameter = app.atlas.parameters[k], { unit, factor } = unitOf(parameter, app.state.units);
    return { k, factor, lower: app.state.lower[k], upper: app.state.upper[k], label: `${app.caption(k)}${unit ? ` [${unit}]` : ""}` };
  });
  if (axes.length > 1) return axes;
  const finite = pane.grid ? [...pane.grid.rho].filter(Number.isFinite) : [], margin = 0.04;
  const low = Math.min(1, ...finite), high = Math.max(1, ...finite), room = (high - low || 1e-3) * margin;
  return [{ factor: 1, lower: low - room, upper: high + room, label: "spectral radius" }, ...axes];
}

/** The contents of a chart: axes, curves, lines, bands. */
export function chartOf(app, pane) {
  const [ay, ax] = axesOf(app, pane), { grid } = pane, line = ay.k === undefined;
  const part = (axis, value) => (value - axis.lower) / (axis.upper - axis.lower);
  const bands = [], chart = { axes: [ay, ax], segments: [], lines: [], bands, curve: null };
  [ay, ax].forEach((axis, across) => {
    if (axis.k === app.speed && app.state.band.every(Number.isFinite)) bands.push([across, ...app.state.band.map((v) => Math.min(Math.max(part(axis, v), 0), 1))]);
  });
  if (!grid) return chart;
  // The grid may still be that of an earlier view: everything is placed by its own ranges.
  const [gy, gx] = [grid.lower, grid.upper][0].length > 1 ? [0, 1] : [null, 0];
  const along = (g, i, count) => grid.lower[g] + ((grid.upper[g] - grid.lower[g]) * (i + 0.5)) / count;
  if (line) {
    chart.curve = [...grid.rho].flatMap((rho, i) => [part(ax, along(0, i, grid.columns)), part(ay, rho)]);
    chart.segments = [0, part(ay, 1), 1, part(ay, 1)];
  } else {
    chart.segments = boundary(grid).map((v, i) => (i % 2 ? part(ay, along(gy, v, grid.rows)) : part(ax, along(gx, v, grid.columns))));
  }
  chart.lines = resonanceLines(app, pane, ay, ax, part);
  return chart;
}

function resonanceLines(app, pane, ay, ax, part) {
  const { atlas } = app, axis = atlas.parameters.findIndex((p) => p.name === atlas.resonances?.axis);
  const across = ax.k === axis, other = across ? ay : ax;
  if (axis < 0 || (!across && ay.k !== axis)) return [];
  const values = [...app.state.panes[pane.number].values], bends = atlas.resonances.parameters.includes(other.k);
  return app.resonances(values).map(({ label, line }, i) => {
    const value = (at) => {
      if (bends) values[other.k] = other.lower + at * (other.upper - other.lower);
      return part(across ? ax : ay, app.resonances(values)[i].value);
    };
    return { label, line, across, points: resonancePath(value, across, bends) };
  });
}

/** Draw the chart and its legend. */
export function draw(app, pane) {
  const { width, height } = size(pane), theme = app.theme();
  const list = marks(chartOf(app, pane), width, height, theme);
  paint(context(pane.base, width, height), list, null);
  if (pane.grid) paintCells(app, pane, list, theme);
  const growth = app.state.panes[pane.number].map === "growth";
  pane.bar.hidden = !(growth && pane.grid);
  if (!pane.bar.hidden) paint(context(pane.bar, width, 40), barMarks(pane.grid, width, theme), null);
  describe(app, pane, theme, growth);
  drawCursor(app, pane);
}

/** The picture of the cells in place of that mark: of an earlier view only what overlaps the new one. */
function paintCells(app, pane, list, theme) {
  const { width, height } = size(pane), box = frame(width, height), { grid } = pane;
  pane.picture = picture(grid, app.state.panes[pane.number].map, THEMES[theme]);
  const target = context(pane.base, width, height);
  const at = app.state.axes.map((k, g) => {
    const span = app.state.upper[k] - app.state.lower[k];
    return [(grid.lower[g] - app.state.lower[k]) / span, (grid.upper[g] - app.state.lower[k]) / span];
  });
  const [y0, y1] = at.length > 1 ? at[0] : [0, 1], [x0, x1] = at.at(-1);
  const [w, h] = [box.w, box.h].map((length) => Math.max(Math.round(length * (window.devicePixelRatio || 1)), 1));
  const layer = create("canvas", { width: w, height: h }), inner = layer.getContext("2d");
  // Cells larger than a pixel keep their edges, smaller ones are averaged.
  inner.imageSmoothingEnabled = (x1 - x0) * w < grid.columns;
  inner.imageSmoothingQuality = "high";
  inner.drawImage(pane.picture, x0 * w, (1 - y1) * h, (x1 - x0) * w, (y1 - y0) * h);
  paint(target, list, layer);
}

/** A canvas with one pixel for each cell. */
export function picture(grid, map, theme) {
  const canvas = create("canvas", { width: grid.columns, height: grid.rows });
  canvas.getContext("2d").putImageData(new ImageData(pixels(grid, map, theme), grid.columns, grid.rows), 0, 0);
  return canvas;
}

/** Width and height of a chart in pixels of the page. */
export function size(pane) {
  const width = Math.max(280, Math.round(pane.stack.clientWidth || 640));
  return { width, height: Math.round(Math.min(Math.max(width * 0.78, 300), 640)) };
}

function context(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  canvas.style.height = `${height}px`;
  const found = canvas.getContext("2d");
  found.scale(canvas.width / width, canvas.height / height);
  return found;
}

function describe(app, pane, theme, growth) {
  const { state } = app, own = state.panes[pane.number];
  const others = app.atlas.parameters.map((p, k) => (state.axes.includes(k) ? "" : `${app.symbol(k)} = ${app.written(k, own.values[k])}`)).filter(Boolean);
  pane.heading.textContent = [state.panes.length > 1 ? "AB"[pane.number] : "", others.join(", ")].filter(Boolean).join(": ");
  pane.map.value = own.map;
  const colours = growth ? [] : THEMES[theme].verdicts.slice(0, 3).map((c, i) => [`rgb(${c})`, ["stable", "unstable", "undecided"][i]]);
  if (app.atlas.gaps.length) colours.push([`repeating-linear-gradient(45deg, rgb(${THEMES[theme].stripe}) 0 2px, rgb(${THEMES[theme].verdicts[3]}) 2px 5px)`, "no panel: not covered"]);
  pane.legend.replaceChildren(...colours.map(([background, word]) => {
    const swatch = create("i");
    swatch.style.background = background;
    return create("li", {}, swatch, word);
  }));
  if (growth) pane.legend.prepend(create("li", {}, "colour: growth per period, ln ρ"));
  const names = state.axes.map((k) => `${app.caption(k)} from ${app.written(k, state.lower[k])} to ${app.written(k, state.upper[k])}`).reverse();
  pane.stack.setAttribute("aria-label", `Chart of ${growth ? "growth" : "stability"}: ${names.join("; ")}. Arrow keys move the point.`);
}

/** The point and the place of the pointer, in all charts alike. */
export function drawCursor(app, pane) {
  const { width, height } = size(pane), box = frame(width, height), [ay, ax] = axesOf(app, pane), theme = THEMES[app.theme()];
  const target = context(pane.above, width, height), values = app.state.panes[0].values;
  target.beginPath();
  target.rect(box.x, box.y, box.w, box.h);
  target.clip();
  const place = (axis, value) => (value - axis.lower) / (axis.upper - axis.lower);
  const cross = (x, y, style, dash) => {
    target.strokeStyle = style;
    target.setLineDash(dash);
    target.beginPath();
    target.moveTo(x, box.y), target.lineTo(x, box.y + box.h);
    if (y !== null) target.moveTo(box.x, y), target.lineTo(box.x + box.w, y);
    target.stroke();
  };
  const at = (source) => [box.x + place(ax, source[ax.k]) * box.w, ay.k === undefined ? null : box.y + (1 - place(ay, source[ay.k])) * box.h];
  const [x, y] = at(values);
  cross(x, y, theme.accent, [4, 3]);
  if (y !== null) {
    target.setLineDash([]);
    target.beginPath();
    target.arc(x, y, 6, 0, 7);
    // A white rim shows the point on every colour.
    for (const [width, style] of [[6, "#ffffff"], [2.5, theme.accent]]) {
      [target.lineWidth, target.strokeStyle] = [width, style];
      target.stroke();
    }
  }
  target.lineWidth = 1;
  if (app.hover) cross(...at(app.hover), theme.muted, []);
}

/** Results at the pointer, or at the point without one. */
export function tell(app, pane) {
  const own = app.state.panes[pane.number], values = [...own.values];
  if (app.hover) app.state.axes.forEach((k) => (values[k] = app.hover[k]));
  const point = app.state.axes.map((k) => values[k]);
  const key = own.values.filter((_, k) => !app.state.axes.includes(k)).join() + app.state.axes;
  if (pane.part?.key !== key) pane.part = Object.assign(slice(app.atlas, own.values, app.state.axes), { key });
  const found = atPoint(pane.part, point), rows = [];
  rows.push(["at", app.state.axes.map((k) => `${app.symbol(k)} = ${app.written(k, values[k])}`).reverse().join(", ")]);
  rows.push(["verdict", found.covered ? WORDS[found.verdict] : "not covered: no panel here"]);
  rows.push(["spectral radius", `${shown(found.spectral_radius, 10)} ± ${shown(found.spectral_radius_error, 2)}`]);
  rows.push(["growth per period", shown(Math.log(found.spectral_radius), 6)]);
  const rate = growthPerSecond(app.atlas, values, found.spectral_radius, app.state.units);
  if (Number.isFinite(rate)) rows.push(["growth per second", `${shown(rate, 6)} 1/s`]);
  else if (!baseFrequency(app.state.units) && app.speed >= 0) rows.push(["growth per second", "give J and k"]);
  const near = own.nearest;
  if (near && !app.hover) near.forEach((each, k) => rows.push([`nearest change along ${app.symbol(k)}`, distances(app, each, k, values[k])]));
  pane.readout.replaceChildren(...rows.map(([name, text]) => create("tr", {}, create("th", { scope: "row" }, name), create("td", {}, text))));
}

function distances(app, { below, above }, k, value) {
  const one = (end, sign) => `${app.written(k, end)} (${sign}${shown(Math.abs(end - value) * unitOf(app.atlas.parameters[k], app.state.units).factor, 4)})`;
  const found = [Number.isNaN(below) ? "" : one(below, "−"), Number.isNaN(above) ? "" : one(above, "+")].filter(Boolean);
  return found.join("; ") || "none within the atlas";
}

// Pixels by which a pointer may move within a click, factor of a step of the wheel.
const STILL = 4, WHEEL = 1.0015;

function listen(pane, app) {
  const { stack } = pane, pointers = new Map();
  let moved = 0, before = null;
  const place = (event) => {
    const { width, height } = size(pane), box = frame(width, height), rect = stack.getBoundingClientRect();
    return [(event.clientX - rect.left - box.x) / box.w, 1 - (event.clientY - rect.top - box.y) / box.h];
  };
  // Middle and distance of the pointers.
  const grip = () => {
    const all = [...pointers.values()], [a, b] = [all[0], all[all.length - 1]];
    return { x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2, apart: all.length > 1 ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0 };
  };
  stack.addEventListener("pointerdown", (event) => {
    stack.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, place(event));
    before = grip();
    if (pointers.size === 1) moved = 0;
  });
  stack.addEventListener("pointermove", (event) => {
    const at = place(event);
    if (!pointers.has(event.pointerId)) return app.point(at);
    moved += Math.abs(event.movementX) + Math.abs(event.movementY);
    pointers.set(event.pointerId, at);
    const now = grip();
    if (moved > STILL) app.zoom(now.apart && before.apart ? before.apart / now.apart : 1, [now.x, now.y], [before.x - now.x, before.y - now.y]);
    // The view has moved with the pointers: they are where they were in it.
    before = now;
  });
  const release = (event) => {
    const click = pointers.size === 1 && moved <= STILL && event.type === "pointerup";
    pointers.delete(event.pointerId);
    if (pointers.size) before = grip();
    if (click) app.pin(place(event));
  };
  stack.addEventListener("pointerup", release);
  stack.addEventListener("pointercancel", release);
  stack.addEventListener("pointerleave", () => app.point(null));
  stack.addEventListener("dblclick", () => app.whole());
  stack.addEventListener("wheel", (event) => {
    event.preventDefault();
    app.zoom(WHEEL ** (event.deltaY * (event.deltaMode ? 30 : 1)), place(event), [0, 0]);
  }, { passive: false });
  stack.addEventListener("keydown", (event) => {
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const step = event.shiftKey ? 0.05 : 0.005;
    if (arrow && event.ctrlKey) app.zoom(1, [0.5, 0.5], arrow.map((v) => v * 0.1));
    else if (arrow) app.move(arrow.map((v) => v * step));
    else if (event.key === "+" || event.key === "=") app.zoom(0.8, app.place(), [0, 0]);
    else if (event.key === "-") app.zoom(1.25, app.place(), [0, 0]);
    else if (event.key === "Home") app.whole();
    else return;
    event.preventDefault();
  });
}
