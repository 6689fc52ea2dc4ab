// A chart as marks (lines, texts, rectangles, an image), painted on a canvas or written as SVG. No DOM.
import { THEMES, extremes, growthColour, ticks, tickText } from "./chart.js";
import { labelText, shown } from "./text.js";

export const MARGIN = { left: 66, right: 36, top: 34, bottom: 50 };
const DASHES = { solid: [], dashed: [5, 3], dashdot: [6, 2, 1, 2] };
// Least distance of two labels of resonances in pixels, and most points of a line.
const ROOM = 24, POINTS = 65;

/** The rectangle of the cells within a chart of this size. */
export function frame(width, height) {
  return { x: MARGIN.left, y: MARGIN.top, w: width - MARGIN.left - MARGIN.right, h: height - MARGIN.top - MARGIN.bottom };
}

/**
 * Marks of a chart: `axes` [{label, factor, lower, upper}] of rows and columns, `segments` of the boundary in parts of the
 * frame, `lines` of resonances [{label, line, points}], `bands` in parts of the frame.
 */
export function marks(chart, width, height, themeName) {
  const theme = THEMES[themeName], box = frame(width, height), [ay, ax] = chart.axes;
  const list = [{ rect: [0, 0, width, height], fill: theme.paper }, { image: [box.x, box.y, box.w, box.h] }];
  for (const [k, a, b] of chart.bands)
    list.push({ rect: k ? [box.x + a * box.w, box.y, (b - a) * box.w, box.h] : [box.x, box.y + (1 - b) * box.h, box.w, (b - a) * box.h], fill: theme.band, inside: true });
  list.push({ segments: placed(chart.segments, box), stroke: theme.boundary, width: 1.1 });
  if (chart.curve) list.push({ path: placed(chart.curve, box), stroke: theme.accent, width: 1.6, inside: true });
  list.push(...resonanceMarks(chart.lines, box, theme));
  list.push({ frame: [box.x, box.y, box.w, box.h], stroke: theme.ink, width: 1 });
  list.push(...axisMarks(ax, box, theme, true), ...axisMarks(ay, box, theme, false));
  return list;
}

const placed = (points, box) => Float64Array.from(points, (v, i) => (i % 2 ? box.y + (1 - v) * box.h : box.x + v * box.w));

function axisMarks(axis, box, theme, across) {
  const low = axis.lower * axis.factor, high = axis.upper * axis.factor, list = [];
  const { step, values } = ticks(low, high, across ? box.w / 90 : box.h / 60);
  for (const value of values) {
    const part = (value - low) / (high - low), text = tickText(value, step);
    const x = box.x + part * box.w, y = box.y + (1 - part) * box.h;
    if (across) list.push({ path: [x, box.y + box.h, x, box.y + box.h + 5], stroke: theme.ink, width: 1 }, { text, at: [x, box.y + box.h + 18], anchor: "middle", fill: theme.ink });
    else list.push({ path: [box.x - 5, y, box.x, y], stroke: theme.ink, width: 1 }, { text, at: [box.x - 8, y + 4], anchor: "end", fill: theme.ink });
  }
  const at = across ? [box.x + box.w / 2, box.y + box.h + 40] : [16, box.y + box.h / 2];
  list.push({ text: axis.label, at, anchor: "middle", fill: theme.ink, turned: !across });
  return list;
}

function resonanceMarks(lines, box, theme) {
  const list = [], taken = [];
  for (const { line, points } of lines) list.push({ path: placed(points, box), stroke: theme.prediction, width: 1, dash: DASHES[line] || [], inside: true });
  // Low orders, which are the last digit of a label, are named first.
  const named = [...lines].sort((a, b) => Number(a.label.at(-1)) - Number(b.label.at(-1)) || 0);
  for (const { label, points, across } of named) {
    const end = points.slice(-2), part = across ? end[0] : end[1];
    const at = across ? box.x + part * box.w : box.y + (1 - part) * box.h;
    if (!(part >= 0 && part <= 1) || taken.some((other) => Math.abs(other - at) < ROOM)) continue;
    taken.push(at);
    list.push({ text: labelText(label), at: across ? [at, box.y - 8] : [box.x + box.w + 5, at + 4], anchor: across ? "middle" : "start", fill: theme.accent });
  }
  return list;
}

/** Points of a resonance in parts of the frame, along the row parameter: `value(row)` at row parameter `part` 0 .. 1. */
export function resonancePath(value, across, bends) {
  const count = bends ? POINTS : 2;
  return Array.from({ length: count }, (_, i) => i / (count - 1)).flatMap((part) => (across ? [value(part), part] : [part, value(part)]));
}

/** Marks of a colour bar for the growth map. */
export function barMarks(grid, width, themeName) {
  const theme = THEMES[themeName], { low, high } = extremes(grid), list = [{ rect: [0, 0, width, 40], fill: theme.paper }];
  const count = 128, left = MARGIN.left, w = width - MARGIN.left - MARGIN.right;
  const value = (part) => (part < 0.25 ? low * (1 - 4 * part) : 1e-5 * Math.expm1(((part - 0.25) / 0.75) * Math.log1p(Math.max(high, 1e-5) / 1e-5)));
  for (let i = 0; i < count; i++)
    list.push({ rect: [left + (i * w) / count, 4, w / count + 0.5, 10], fill: `rgb(${growthColour(value((i + 0.5) / count), low, high, theme).map(Math.round)})` });
  for (const [part, anchor] of [[0, "start"], [0.25, "middle"], [0.625, "middle"], [1, "end"]])
    list.push({ text: shown(value(part) * Math.LN10, 2), at: [left + part * w, 28], anchor, fill: theme.ink });
  return list;
}

/** Paint marks; `image` is what stands in place of the cells. */
export function paint(context, list, image) {
  for (const mark of list) {
    context.save();
    if (mark.inside) context.beginPath(), context.rect(...list.find((m) => m.image).image), context.clip();
    if (mark.image && image) (context.imageSmoothingEnabled = false), context.drawImage(image, ...mark.image);
    if (mark.rect) (context.fillStyle = mark.fill), context.fillRect(...mark.rect);
    if (mark.stroke) (context.strokeStyle = mark.stroke), (context.lineWidth = mark.width), context.setLineDash(mark.dash || []);
    if (mark.frame) context.strokeRect(...mark.frame);
    if (mark.path) stroke(context, mark.path, mark.path.length);
    if (mark.segments) stroke(context, mark.segments, 4);
    if (mark.text) write(context, mark);
    context.restore();
  }
}

/** Lines through points [x, y, ...], a new one after every `length` numbers. */
function stroke(context, points, length) {
  context.beginPath();
  for (let i = 0; i < points.length; i += 2) i % length ? context.lineTo(points[i], points[i + 1]) : context.moveTo(points[i], points[i + 1]);
  context.stroke();
}

function write(context, { text, at, anchor, fill, turned }) {
  context.fillStyle = fill;
  context.font = "12px system-ui, sans-serif";
  context.textAlign = { start: "left", middle: "center", end: "right" }[anchor];
  context.translate(...at);
  if (turned) context.rotate(-Math.PI / 2);
  context.fillText(text, 0, 0);
}

const escaped = (text) => text.replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
const round = (v) => Math.round(v * 100) / 100;

/** The marks as an SVG document; `image` is the address (data:) of a picture of the cells. */
export function svg(list, width, height, image) {
  const box = list.find((mark) => mark.image).image;
  const path = (points, length) => Array.from({ length: points.length / 2 }, (_, i) => `${(2 * i) % length ? "L" : "M"}${round(points[2 * i])} ${round(points[2 * i + 1])}`).join("");
  const line = (m) => `fill="none" stroke="${m.stroke}" stroke-width="${m.width}"${m.dash?.length ? ` stroke-dasharray="${m.dash}"` : ""}`;
  const clip = (m) => (m.inside ? ' clip-path="url(#cells)"' : "");
  const rect = ([x, y, w, h]) => `x="${round(x)}" y="${round(y)}" width="${round(w)}" height="${round(h)}"`;
  const parts = list.map((m) => {
    if (m.image) return image ? `<image ${rect(m.image)} preserveAspectRatio="none" style="image-rendering:pixelated" href="${image}"/>` : "";
    if (m.rect) return `<rect ${rect(m.rect)} fill="${m.fill}"${clip(m)}/>`;
    if (m.frame) return `<rect ${rect(m.frame)} ${line(m)}/>`;
    if (m.path) return `<path d="${path(m.path, m.path.length)}" ${line(m)}${clip(m)}/>`;
    if (m.segments) return `<path d="${path(m.segments, 4)}" ${line(m)}/>`;
    const [x, y] = m.at.map(round), turn = m.turned ? ` transform="rotate(-90 ${x} ${y})"` : "";
    return `<text x="${x}" y="${y}" text-anchor="${m.anchor}" fill="${m.fill}"${turn}>${escaped(m.text)}</text>`;
  });
  const head = `<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${height}" viewBox="0 0 ${width} ${height}" font-family="sans-serif" font-size="12">`;
  return `${head}<clipPath id="cells"><rect ${rect(box)}/></clipPath>${parts.join("")}</svg>`;
}
