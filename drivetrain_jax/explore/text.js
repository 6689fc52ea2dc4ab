// Texts of the page: numbers, the state in the address, scenes, commands, tables. No DOM.

/** A number with as many digits as a reader needs. */
export function shown(value, digits = 6) {
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "none" : value > 0 ? "∞" : "-∞";
  return String(Number(value.toPrecision(digits)));
}

/** A label of a resonance with its index: H12 as H₁₂, C+1 as C⁺₁. */
export function labelText(label) {
  const parts = /^([A-Za-z]+)([+-]?)(\d+)$/.exec(label);
  if (!parts) return label;
  const sign = parts[2] === "+" ? "⁺" : parts[2] === "-" ? "⁻" : "";
  return parts[1] + sign + [...parts[3]].map((digit) => "₀₁₂₃₄₅₆₇₈₉"[digit]).join("");
}

/** Symbol, meaning and unit under which a parameter is shown, and the factor from the atlas's number to the reader's. */
export function unitOf(parameter, units) {
  const { symbol, long_name: name, view } = parameter, speed = parameter.role === "speed";
  if (parameter.units === "rad" && units.angle === "deg") return { symbol, name, unit: "°", factor: 180 / Math.PI };
  if (view && (!speed || units.speed === "rpm")) return { symbol: view.symbol, name: view.long_name, unit: view.units === "1" ? "" : view.units, factor: view.factor };
  const base = baseFrequency(units);
  if (speed && parameter.units === "1" && units.speed === "rpm" && base)
    // In rpm it is the speed itself, not its ratio to a frequency.
    return { symbol: "speed", name: name.split(" over ")[0], unit: "rpm", factor: (base * 30) / Math.PI };
  return { symbol, name, unit: parameter.units === "1" ? "" : parameter.units, factor: 1 };
}

/** sqrt(k/J) in rad/s of the numbers that the reader has given, NaN without them. */
export function baseFrequency({ J, k }) {
  return J > 0 && k > 0 ? Math.sqrt(k / J) : NaN;
}

/** The growth rate in 1/s where the period in seconds is known, else NaN. */
export function growthPerSecond(atlas, values, rho, units) {
  if (!atlas.time) return NaN;
  if (atlas.time.units === "s") return Math.log(rho) / atlas.time.period;
  // Time without a unit is the angle by which the shaft has turned.
  const speed = atlas.parameters.findIndex((p) => p.role === "speed" && p.units === "1");
  return speed < 0 ? NaN : (Math.log(rho) * values[speed] * baseFrequency(units)) / atlas.time.period;
}

const number = (value) => (Number.isInteger(value) && Math.abs(value) < 1e15 ? `${value}.0` : String(value));
// Name and value of a parameter as a scene gives them, with the digits of a slider.
const given = ({ name, units: own, view }, value, units) => {
  if (view) return [view.symbol, `${shown(value * view.factor, 12)}${view.units === "1" ? "" : ` ${view.units}`}`];
  return [name, own === "rad" && units.angle === "deg" ? `${shown((value * 180) / Math.PI, 12)} deg` : Number(value.toPrecision(12))];
};
const entry = (value) => (typeof value === "string" ? quoted(value) : number(value));
// TOML has the escapes of JSON, and one control character more to escape.
const quoted = (text) => JSON.stringify(text).replaceAll("\u007f", "\\u007f");
// Words within single quotes reach a command as they are.
const word = (text) => (/^[\w.+=:-]+$/.test(text) ? text : `'${text.replaceAll("'", `'\\''`)}'`);

/** The visible chart as a scene of the analysis `floquet`, with `num` values an axis. */
export function sceneText(atlas, { axes, values, lower, upper, units }, num = 201) {
  const lines = [`title = ${quoted(atlas.title || "")}`, `system = ${quoted(atlas.system.name)}`, 'analysis = "floquet"', "", "[axes]"];
  const written = (k, value) => given(atlas.parameters[k], value, units), said = (k, value) => entry(written(k, value)[1]);
  for (const k of axes) lines.push(`${written(k, lower[k])[0]} = { start = ${said(k, lower[k])}, stop = ${said(k, upper[k])}, num = ${num} }`);
  lines.push("", "[fixed]");
  values.forEach((value, k) => axes.includes(k) || lines.push(`${written(k, value)[0]} = ${said(k, value)}`));
  for (const [name, text] of Object.entries(atlas.given)) lines.push(`${name} = ${text}`);
  return [...lines, "", "[options]", `rtol = ${number(atlas.rtol)}`, ""].join("\n");
}

/** The command that solves one point directly. */
export function commandText(atlas, values, units) {
  const words = [...atlas.parameters.map((p, k) => given(p, values[k], units)), ...Object.entries(atlas.given)].map(([name, value]) => `${name}=${value}`);
  return ["drivetrain", "point", atlas.system.name, "floquet", ...words].map(word).join(" ");
}

const VERDICTS = ["stable", "unstable", "undecided", "not covered"];

/** A grid as comma-separated values; `names` are those of rows and columns. */
export function csvText(grid, names, xs, ys) {
  const lines = [[...names, "spectral_radius", "spectral_radius_error", "verdict"].join(",")];
  for (let r = 0; r < grid.rows; r++)
    for (let c = 0; c < grid.columns; c++) {
      const i = r * grid.columns + c, place = names.length > 1 ? [ys[r], xs[c]] : [xs[c]];
      lines.push([...place, grid.rho[i], grid.error[i], VERDICTS[grid.verdict[i]]].join(","));
    }
  return lines.join("\n") + "\n";
}

/** The state as text behind `#`. */
export function toHash(atlas, state) {
  const said = new URLSearchParams(), { names = atlas.parameters.map((p) => p.name) } = {};
  names.forEach((name, k) => said.set(name, shown(state.panes[0].values[k], 12)));
  said.set("x", names[state.axes.at(-1)]);
  if (state.axes.length > 1) said.set("y", names[state.axes[0]]);
  state.axes.forEach((k) => {
    const { lower, upper } = atlas.parameters[k];
    if (state.lower[k] !== lower || state.upper[k] !== upper) said.set(`view.${names[k]}`, `${shown(state.lower[k], 12)}:${shown(state.upper[k], 12)}`);
  });
  state.panes.forEach((pane, i) => pane.map !== "verdict" && said.set(i ? "B.map" : "map", pane.map));
  if (state.panes.length > 1)
    names.forEach((name, k) => state.axes.includes(k) || said.set(`B.${name}`, shown(state.panes[1].values[k], 12)));
  if (state.panes.length > 1) said.set("compare", "1");
  for (const key of ["angle", "speed", "J", "k"]) if (state.units[key] && state.units[key] !== atlas.units[key]) said.set(key, state.units[key]);
  if (state.band.every(Number.isFinite)) said.set("band", state.band.map((v) => shown(v, 12)).join(":"));
  return said.toString().replaceAll("%3A", ":");
}

/** The state that the text behind `#` describes; what is not valid there is left as it is by default. */
export function fromHash(atlas, text) {
  const said = new URLSearchParams(text), names = atlas.parameters.map((p) => p.name);
  const clamp = (k, v, fallback) => (Number.isFinite(v) ? Math.min(Math.max(v, atlas.parameters[k].lower), atlas.parameters[k].upper) : fallback);
  const get = (key) => (said.has(key) && said.get(key).trim() ? Number(said.get(key)) : NaN);
  const middle = (k) => (atlas.parameters[k].lower + atlas.parameters[k].upper) / 2;
  const values = names.map((name, k) => clamp(k, get(name), middle(k)));
  const axes = chosenAxes(atlas, said.get("x"), said.get("y"));
  const lower = atlas.parameters.map((p) => p.lower), upper = atlas.parameters.map((p) => p.upper);
  for (const k of axes) {
    const [a, b] = (said.get(`view.${names[k]}`) || "").split(":").map((v) => clamp(k, v.trim() ? Number(v) : NaN, NaN));
    if (a < b) [lower[k], upper[k]] = [a, b];
  }
  const map = (key) => (said.get(key) === "growth" ? "growth" : "verdict");
  const panes = [{ values, map: map("map") }];
  if (said.get("compare")) panes.push({ values: names.map((name, k) => (axes.includes(k) ? values[k] : clamp(k, get(`B.${name}`), values[k]))), map: map("B.map") });
  const band = (said.get("band") || ":").split(":").map((v) => (v.trim() ? Number(v) : NaN));
  const either = (key, ...words) => (words.includes(said.get(key)) ? said.get(key) : atlas.units[key]);
  const units = { angle: either("angle", "rad", "deg"), speed: either("speed", "1", "rpm"), J: get("J") || (atlas.units.J ?? NaN), k: get("k") || (atlas.units.k ?? NaN) };
  return { axes, lower, upper, panes, units, band: band.length === 2 && band[0] < band[1] ? band : [NaN, NaN] };
}

/** Rows and columns of the chart: the axis of the resonances or the speed is horizontal unless the reader wants others. */
function chosenAxes(atlas, x, y) {
  const find = (name) => atlas.parameters.findIndex((p) => p.name === name);
  const speed = Math.max(find(atlas.resonances?.axis), atlas.parameters.findIndex((p) => p.role === "speed"));
  const across = find(x) >= 0 ? find(x) : Math.max(speed, 0);
  if (atlas.parameters.length === 1) return [0];
  const other = find(y) >= 0 && find(y) !== across ? find(y) : atlas.parameters.findIndex((p, k) => k !== across && p.role === "angle");
  return [other >= 0 ? other : across ? 0 : 1, across];
}
