// The page: its state, controls, and the workers that evaluate the atlas.
import { THEMES, resonances } from "./chart.js";
import { evaluate, openAtlas } from "./evaluate.js";
import { frame, marks, paint, svg } from "./marks.js";
import { chartOf, draw, drawCursor, makePane, picture, size, tell } from "./pane.js";
import { commandText, csvText, fromHash, sceneText, shown, toHash, unitOf } from "./text.js";
import { answer } from "./worker.js";

const data = JSON.parse(document.getElementById("data").textContent);
const get = (id) => document.getElementById(id);
// Cells along an axis: of the first picture, of later ones, and of a table. Milliseconds for a picture while something moves.
const SIZES = [64, 128, 256, 512, 1024], TABLE = 256, PATIENCE = 90;
// Milliseconds of rest before a finer picture, and before distances are searched.
const REST = 180;
// Smallest part of a range that a view may show.
const SMALLEST = 1e-7;

/** Workers that answer questions, or the page itself where it may have none. */
function makeWorkers(atlas) {
  const waiting = new Map(), workers = [];
  let last = 0, turn = 0;
  try {
    const source = new Blob([get("evaluation").textContent], { type: "text/javascript" }), address = URL.createObjectURL(source);
    for (let i = 0; i < Math.min(Math.max(navigator.hardwareConcurrency || 2, 1), 4); i++) {
      const worker = new Worker(address);
      worker.onmessage = ({ data: { id, found } }) => (waiting.get(id).resolve(found), waiting.delete(id));
      worker.onerror = () => {
        // What it was asked, and all that follows, the page answers itself.
        workers.length = 0;
        for (const { resolve, question } of waiting.values()) resolve(answer(atlas, question));
        waiting.clear();
      };
      worker.postMessage({ open: data });
      workers.push(worker);
    }
  } catch {
    workers.length = 0;
  }
  const ask = (question) => new Promise((resolve) => {
    if (!workers.length) return setTimeout(() => resolve(answer(atlas, question)));
    waiting.set(++last, { resolve, question });
    workers[turn++ % workers.length].postMessage({ id: last, question });
  });
  return { ask, count: () => Math.max(workers.length, 1) };
}

const start = () => {
  const atlas = openAtlas(data), workers = makeWorkers(atlas), dark = matchMedia("(prefers-color-scheme: dark)");
  const app = {
    atlas, workers, hover: null, panes: [], printing: false, level: 1, cost: 0, busy: false, again: false,
    state: fromHash(atlas, location.hash.slice(1)),
    resonances: resonances(atlas),
    speed: atlas.parameters.findIndex((p) => p.role === "speed"),
    theme: () => (dark.matches && !app.printing ? "dark" : "light"),
    caption: (k) => {
      const { symbol, name, unit } = unitOf(atlas.parameters[k], app.state.units);
      return unit === "rpm" ? name : `${symbol}, ${name}`;
    },
    symbol: (k) => unitOf(atlas.parameters[k], app.state.units).symbol,
    written: (k, value) => {
      const { unit, factor } = unitOf(atlas.parameters[k], app.state.units);
      return shown(value * factor, 6) + (unit === "°" ? unit : unit && ` ${unit}`);
    },
  };
  Object.assign(app, actions(app));
  buildControls(app);
  app.rebuild();
  dark.addEventListener("change", () => app.paint());
  new ResizeObserver(() => app.paint()).observe(get("charts"));
  addEventListener("beforeprint", () => ((app.printing = true), app.paint()));
  addEventListener("afterprint", () => ((app.printing = false), app.paint()));
  addEventListener("hashchange", () => {
    if (location.hash.slice(1) === toHash(atlas, app.state)) return;
    app.state = fromHash(atlas, location.hash.slice(1));
    app.rebuild();
  });
  return app;
};

/** Put the state into the address; a page within another one (`srcdoc`) has none. */
function remember(text) {
  try {
    history.replaceState(null, "", `#${text}`);
  } catch {
    // The state is then that of the page alone.
  }
}

/** Changes of the state that charts and controls ask for. */
function actions(app) {
  const { atlas } = app, of = (k) => atlas.parameters[k];
  const clamp = (k, value) => Math.min(Math.max(value, of(k).lower), of(k).upper);
  // Places in the frame are [across, up]; axes are rows, columns.
  const axesAcross = () => (app.state.axes.length > 1 ? [app.state.axes[1], app.state.axes[0]] : [app.state.axes[0]]);
  const valueAt = (k, part) => app.state.lower[k] + part * (app.state.upper[k] - app.state.lower[k]);
  const setPoint = (set) => app.change((state) => {
    axesAcross().forEach((k, i) => state.panes.forEach((pane) => (pane.values[k] = clamp(k, set(k, i, pane.values[k])))));
  }, false);
  return {
    change(edit, compute = true) {
      edit(app.state);
      app.state.panes.forEach((pane) => (pane.nearest = null));
      showControls(app);
      compute ? compute === "whole" ? app.rebuild() : app.compute() : app.cursor();
      app.rest();
    },
    rebuild() {
      app.panes = app.state.panes.map((_, number) => app.panes[number] || makePane(app, number));
      get("charts").replaceChildren(...app.panes.map((pane) => pane.node));
      for (const pane of app.panes) (pane.grid = null), (pane.part = null);
      buildParameters(app);
      showControls(app);
      app.paint();
      app.compute();
      app.rest();
    },
    paint: () => app.panes.forEach((pane) => (draw(app, pane), tell(app, pane))),
    cursor: () => app.panes.forEach((pane) => (drawCursor(app, pane), tell(app, pane))),
    point(at) {
      app.hover = at && at.every((v) => v >= 0 && v <= 1) ? [...app.state.panes[0].values] : null;
      if (app.hover) axesAcross().forEach((k, i) => (app.hover[k] = clamp(k, valueAt(k, at[i]))));
      app.cursor();
    },
    pin: (at) => at.every((v) => v >= 0 && v <= 1) && setPoint((k, i) => valueAt(k, at[i])),
    move: (steps) => ((app.hover = null), setPoint((k, i, value) => value + steps[i] * (app.state.upper[k] - app.state.lower[k]))),
    place: () => axesAcross().map((k) => (app.state.panes[0].values[k] - app.state.lower[k]) / (app.state.upper[k] - app.state.lower[k])),
    zoom: (factor, about, shift) => app.change((state) => {
      axesAcross().forEach((k, i) => {
        const span = state.upper[k] - state.lower[k], whole = of(k).upper - of(k).lower;
        const next = Math.min(Math.max(span * factor, whole * SMALLEST), whole);
        const low = valueAt(k, about[i]) - about[i] * next + shift[i] * span;
        state.lower[k] = Math.min(Math.max(low, of(k).lower), of(k).upper - next);
        state.upper[k] = Math.min(state.lower[k] + next, of(k).upper);
      });
    }),
    whole: () => app.change((state) => axesAcross().forEach((k) => ([state.lower[k], state.upper[k]] = [of(k).lower, of(k).upper]))),
    rest() {
      clearTimeout(app.timer);
      app.timer = setTimeout(() => {
        remember(toHash(atlas, app.state));
        app.refine();
        app.measure();
      }, REST);
    },
    ...drawing(app),
  };
}

/** Evaluate charts: quickly while something moves, then finer. */
function drawing(app) {
  const { atlas, workers } = app;
  const centres = (k, n) => Float64Array.from({ length: n }, (_, i) => app.state.lower[k] + ((app.state.upper[k] - app.state.lower[k]) * (i + 0.5)) / n);
  async function grid(pane, n) {
    const { axes } = app.state, values = app.state.panes[pane.number].values.slice(), xs = centres(axes.at(-1), axes.length > 1 ? n : 2 * n);
    const ranges = { lower: axes.map((k) => app.state.lower[k]), upper: axes.map((k) => app.state.upper[k]) };
    if (axes.length === 1) return { ...(await workers.ask({ values, axes, xs })), ...ranges };
    const ys = centres(axes[0], n), parts = workers.count();
    const pieces = await Promise.all(Array.from({ length: parts }, (_, i) => {
      const rows = ys.subarray(Math.floor((i * n) / parts), Math.floor(((i + 1) * n) / parts));
      return workers.ask({ values, axes, xs, ys: rows.slice() });
    }));
    const whole = { columns: n, rows: n, rho: new Float64Array(n * n), error: new Float64Array(n * n), verdict: new Uint8Array(n * n), ...ranges };
    let at = 0;
    for (const piece of pieces) {
      for (const name of ["rho", "error", "verdict"]) whole[name].set(piece[name], at);
      at += piece.rho.length;
    }
    return whole;
  }
  const quick = () => {
    const fit = SIZES.filter((n) => n <= 512 && app.cost * n * n * app.panes.length <= PATIENCE);
    return app.cost ? (fit.at(-1) ?? SIZES[0]) : SIZES[1];
  };
  async function run(n) {
    if (app.busy) return void (app.again = true);
    app.busy = true;
    app.again = false;
    const begin = performance.now(), panes = [...app.panes];
    const grids = await Promise.all(panes.map((pane) => grid(pane, n)));
    app.cost = (performance.now() - begin) / (n * n * panes.length);
    app.busy = false;
    app.level = n;
    const { axes } = app.state;
    // A chart of other axes is not of this state any more.
    if (panes.every((pane, i) => app.panes[i] === pane)) grids.forEach((found, i) => found.lower.length === axes.length && (panes[i].grid = found));
    app.paint();
    app.last = performance.now() - begin;
    if (app.again) await run(quick());
  }
  return {
    compute: () => run(quick()),
    async refine() {
      const state = toHash(atlas, app.state), most = app.panes.reduce((m, pane) => Math.max(m, frame(...Object.values(size(pane))).w * (devicePixelRatio || 1)), 0);
      for (const n of SIZES.filter((n, i) => n > app.level && SIZES[i - 1] < most)) {
        while (app.busy) await new Promise((resolve) => setTimeout(resolve, 20));
        if (toHash(atlas, app.state) !== state) return;
        await run(n);
      }
    },
    async measure() {
      const state = toHash(atlas, app.state);
      const found = await Promise.all(app.state.panes.map((pane) => workers.ask({ values: pane.values, distances: true })));
      if (toHash(atlas, app.state) !== state) return;
      app.state.panes.forEach((pane, i) => (pane.nearest = found[i]));
      app.cursor();
    },
  };
}

/** Controls that are there once. */
function buildControls(app) {
  const { atlas } = app, changeTo = (id, edit, whole = true) => get(id).addEventListener("change", () => app.change((state) => edit(state, get(id)), whole && "whole"));
  get("title").textContent = atlas.title || atlas.system.title;
  get("about").textContent = [atlas.system.title, ...Object.values(atlas.fixed)].join(", ") + `; ${atlas.proof}.`;
  for (const id of ["across", "up"]) get(id).append(...atlas.parameters.map((p, k) => new Option(app.caption(k), p.name)));
  const swap = (state, at, name) => {
    const k = atlas.parameters.findIndex((p) => p.name === name), other = state.axes.length - 1 - at;
    if (state.axes[other] === k && other !== at) state.axes[other] = state.axes[at];
    state.axes[at] = k;
    // Values along axes are those of both charts.
    for (const pane of state.panes) for (const axis of state.axes) pane.values[axis] = state.panes[0].values[axis];
  };
  changeTo("across", (state, { value }) => swap(state, state.axes.length - 1, value));
  changeTo("up", (state, { value }) => swap(state, 0, value));
  changeTo("compare", (state, { checked }) => (state.panes = checked ? [state.panes[0], { ...state.panes[0], values: [...state.panes[0].values] }] : state.panes.slice(0, 1)));
  get("reset").addEventListener("click", () => app.whole());
  changeTo("angle", (state, { value }) => (state.units.angle = value));
  changeTo("speed", (state, { value }) => (state.units.speed = value));
  for (const id of ["J", "k"]) changeTo(id, (state, field) => (state.units[id] = checked(field, (v) => v > 0 || !field.value.trim()) ?? NaN));
  for (const [i, id] of ["low", "high"].entries()) changeTo(id, (state, field) => (state.band[i] = (checked(field, (v) => v >= 0 || !field.value.trim()) ?? NaN) / unitOf(atlas.parameters[app.speed], state.units).factor), false);
  get("low").addEventListener("change", () => app.paint());
  get("high").addEventListener("change", () => app.paint());
  get("up-label").hidden = atlas.parameters.length < 2;
  get("angle-label").hidden = !atlas.parameters.some((p) => p.units === "rad");
  for (const label of document.querySelectorAll(".speed")) label.hidden = app.speed < 0 || atlas.parameters[app.speed].units !== "1";
  const speed = atlas.parameters[app.speed]?.view;
  if (speed) {
    // A file with the shaft's data needs no more.
    for (const id of ["J", "k"]) get(id).parentElement.hidden = true;
    get("speed").options[1].textContent = speed.units;
  }
  get("band-label").hidden = app.speed < 0;
  buildExports(app);
}

/** The number in a field, or undefined (and the field marked) if it is none that is allowed. */
function checked(field, allowed) {
  const value = field.value.trim() ? Number(field.value.replace(",", ".")) : NaN, fine = allowed(value);
  field.setAttribute("aria-invalid", String(!fine));
  return fine ? value : undefined;
}

/** Sliders and number fields; of parameters that are no axis one for each chart. */
function buildParameters(app) {
  const { atlas, state } = app;
  get("parameters").replaceChildren(...atlas.parameters.map((parameter, k) => {
    const row = document.createElement("div"), name = document.createElement("div"), axis = state.axes.includes(k);
    row.className = "parameter";
    name.className = "name";
    const seen = unitOf(parameter, state.units);
    name.textContent = `${seen.symbol} `;
    name.append(Object.assign(document.createElement("small"), { textContent: seen.name + (seen.unit && ` [${seen.unit}]`) }));
    row.append(name);
    state.panes.slice(0, axis ? 1 : 2).forEach((_, number) => row.append(...slider(app, k, number, axis)));
    if (axis) row.append(viewFields(app, k));
    return row;
  }));
}

function slider(app, k, number, axis) {
  const parameter = app.atlas.parameters[k], label = `${unitOf(parameter, app.state.units).name}${app.state.panes.length > 1 && !axis ? `, chart ${"AB"[number]}` : ""}`;
  const range = Object.assign(document.createElement("input"), { type: "range", min: 0, max: 1, step: "any", ariaLabel: label });
  const field = Object.assign(document.createElement("input"), { ariaLabel: `${label}, number`, inputMode: "decimal" });
  const set = (value) => app.change((state) => state.panes.forEach((pane, i) => (axis || i === number) && (pane.values[k] = value)), !axis);
  // By rounding the sum may lie beyond the end.
  range.addEventListener("input", () => set(Math.min(parameter.lower + range.valueAsNumber * (parameter.upper - parameter.lower), parameter.upper)));
  field.addEventListener("change", () => {
    const { factor } = unitOf(parameter, app.state.units), value = checked(field, (v) => inRange(parameter, v / factor));
    if (value !== undefined) set(Math.min(Math.max(value / factor, parameter.lower), parameter.upper));
  });
  range.dataset.slider = field.dataset.field = `${k} ${number}`;
  return [range, field];
}

// Relative distance by which a number typed in may lie outside of a range: it is rounded.
const inRange = ({ lower, upper }, value) => value >= lower - 1e-5 * (upper - lower) && value <= upper + 1e-5 * (upper - lower);

function viewFields(app, k) {
  const parameter = app.atlas.parameters[k], view = document.createElement("div");
  view.className = "view";
  const fields = ["lower", "upper"].map((end) => {
    const field = Object.assign(document.createElement("input"), { ariaLabel: `${unitOf(parameter, app.state.units).name}, ${end} end of the view`, inputMode: "decimal", size: 8 });
    field.dataset.view = `${k} ${end}`;
    field.style.width = "6.5em";
    field.addEventListener("change", () => {
      const { factor } = unitOf(parameter, app.state.units);
      const fits = (v) => inRange(parameter, v / factor) && (end === "lower" ? v / factor < app.state.upper[k] : v / factor > app.state.lower[k]);
      const value = checked(field, fits);
      if (value !== undefined) app.change((state) => (state[end][k] = Math.min(Math.max(value / factor, parameter.lower), parameter.upper)));
    });
    return field;
  });
  view.append("shown from ", fields[0], " to ", fields[1]);
  return view;
}

/** Bring all controls to the state, except the field that the reader is typing in. */
function showControls(app) {
  const { atlas, state } = app, put = (field, text) => (field !== document.activeElement || field.getAttribute("aria-invalid") !== "true") && (field.value = text);
  get("across").value = atlas.parameters[state.axes.at(-1)].name;
  get("up").value = atlas.parameters[state.axes[0]].name;
  get("compare").checked = state.panes.length > 1;
  for (const key of ["angle", "speed"]) get(key).value = state.units[key];
  for (const key of ["J", "k"]) put(get(key), Number.isFinite(state.units[key]) ? shown(state.units[key], 12) : "");
  for (const field of document.querySelectorAll("[data-slider], [data-field], [data-view]")) {
    const [k, which] = (field.dataset.slider ?? field.dataset.field ?? field.dataset.view).split(" "), parameter = atlas.parameters[k];
    const value = field.dataset.view ? state[which][k] : state.panes[which]?.values[k];
    const { unit, factor } = unitOf(parameter, state.units);
    if (field.dataset.slider) {
      field.value = (value - parameter.lower) / (parameter.upper - parameter.lower);
      field.setAttribute("aria-valuetext", `${shown(value * factor)} ${unit}`);
    } else put(field, shown(value * factor, 8));
  }
  if (app.speed < 0) return;
  const { unit, factor } = unitOf(atlas.parameters[app.speed], state.units);
  get("band-unit").textContent = unit;
  [get("low"), get("high")].forEach((field, i) => put(field, Number.isFinite(state.band[i]) ? shown(state.band[i] * factor, 8) : ""));
}

/** Buttons that copy and download. */
function buildExports(app) {
  const { atlas } = app, say = (text) => (get("said").textContent = text);
  const copy = async (text, what) => {
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      // Pages from a file may not write to the clipboard in every browser.
      const area = document.body.appendChild(Object.assign(document.createElement("textarea"), { value: text }));
      area.select();
      document.execCommand("copy");
      area.remove();
    }
    say(`${what} copied`);
  };
  const save = (name, blob) => {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1e4);
    say(`${name} written`);
  };
  const scene = () => sceneText(atlas, { axes: app.state.axes, values: app.state.panes[0].values, lower: app.state.lower, upper: app.state.upper, units: app.state.units });
  const command = () => commandText(atlas, app.state.panes[0].values, app.state.units);
  get("scene").addEventListener("click", () => copy(scene(), "scene"));
  get("command").addEventListener("click", () => copy(command(), "command"));
  get("link").addEventListener("click", () => copy(`${location.href.split("#")[0]}#${toHash(atlas, app.state)}`, "address"));
  const images = () => app.panes.filter((pane) => pane.grid).map((pane) => ({ pane, ...size(pane), list: marks(chartOf(app, pane), ...Object.values(size(pane)), app.theme()) }));
  get("png").addEventListener("click", () => images().forEach(({ pane, width, height, list }) => {
    const canvas = Object.assign(document.createElement("canvas"), { width: 2 * width, height: 2 * height }), target = canvas.getContext("2d");
    target.scale(2, 2);
    paint(target, list, picture(pane.grid, app.state.panes[pane.number].map, THEMES[app.theme()]));
    canvas.toBlob((blob) => save(`chart${"AB"[pane.number]}.png`, blob));
  }));
  get("svg").addEventListener("click", () => images().forEach(({ pane, width, height, list }) => {
    const cells = picture(pane.grid, app.state.panes[pane.number].map, THEMES[app.theme()]).toDataURL();
    save(`chart${"AB"[pane.number]}.svg`, new Blob([svg(list, width, height, cells)], { type: "image/svg+xml" }));
  }));
  get("csv").addEventListener("click", () => app.panes.forEach((pane) => {
    const { axes, lower, upper } = app.state, [xs, ys] = [axes.at(-1), axes[0]].map((k) => Float64Array.from({ length: TABLE }, (_, i) => Math.min(lower[k] + ((upper[k] - lower[k]) * i) / (TABLE - 1), upper[k])));
    const question = { values: app.state.panes[pane.number].values, axes, xs, ys };
    save(`chart${"AB"[pane.number]}.csv`, new Blob([csvText(answer(atlas, question), axes.map((k) => atlas.parameters[k].name), xs, ys)], { type: "text/csv" }));
  }));
  Object.assign(app, { scene, command });
}

const app = start();
window.drivetrain = {
  /** Resolves once `evaluate` may be asked. */
  ready: Promise.resolve(),
  /** Spectral radius, its bound and the verdict (0 stable, 1 unstable, 2 undecided) at a point. */
  evaluate: (values) => {
    const { spectral_radius, spectral_radius_error, verdict } = evaluate(app.atlas, values);
    return { spectral_radius, spectral_radius_error, verdict };
  },
  /** For tests: the state, and how long the last picture took. */
  app,
};
