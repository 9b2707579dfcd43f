// Charts as SVG: values over time with their limits, bars by size, and readings.

import { element, figure, percent, svg } from "./common.js";

const LEFT = 62;

/** A chart under its title, drawn by `draw({ title, width })` for its present width. */
export function fitted(title, draw) {
  const place = element("div", { class: "fitted" });
  let drawn = 0;
  new ResizeObserver(([entry]) => {
    const width = Math.round(entry.contentRect.width);
    if (width === 0 || width === drawn) return;
    drawn = width;
    place.replaceChildren(draw({ title, width }));
  }).observe(place);
  return element("figure", {}, element("figcaption", {}, title), place);
}

/** Round steps that cover [low, high]. */
function ticks(low, high, count = 4) {
  const rough = (high - low) / count || Math.abs(high) || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((f) => f * power).find((s) => s >= rough * 0.999);
  const found = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + step * 1e-9; v += step) found.push(Math.abs(v) < step * 1e-9 ? 0 : v);
  return found;
}

const sure = (values) => values.filter((v) => v !== null && v !== undefined && Number.isFinite(v));

/** Digits that tell neighbouring marks apart. */
function marked(marks) {
  for (let digits = 2; digits < 9; digits += 1) {
    const texts = marks.map((v) => figure(v, digits));
    if (new Set(texts).size === texts.length && marks.every((v, i) => i === 0 || Math.abs(v) > 0 || texts[i] === "0")) return texts;
  }
  return marks.map((v) => figure(v, 9));
}

/** Axes for the values; `below` and `over` are the room for what stands there. */
function frame({ title, width, height, below, over = 10, role = "img" }, values) {
  const seen = sure(values);
  let [low, high] = [Math.min(...seen), Math.max(...seen)];
  const margin = (high - low || Math.abs(high) * 0.1 || 1) * 0.07;
  [low, high] = [low - margin, high + margin];
  const [top, bottom] = [over, height - below];
  const y = (v) => bottom - ((v - low) / (high - low)) * (bottom - top);
  const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, class: "chart", role, "aria-label": title });
  const marks = ticks(low, high, Math.max(3, Math.round((bottom - top) / 45)));
  const texts = marked(marks);
  marks.forEach((v, i) => {
    picture.append(svg("line", { x1: LEFT, x2: width, y1: y(v), y2: y(v), class: "grid" }),
      svg("text", { x: LEFT - 6, y: y(v) + 4, "text-anchor": "end" }, texts[i]));
  });
  return { picture, y, top, bottom };
}

/** A control chart: `points` [{value, label, href, mark, beyond, limit}] in their
 * order, `mark` null, `outside` (a square) or `run` (a diamond), `beyond` whether it is
 * above the limit of the station (a triangle over it), `lines` [{value, kind}] of the
 * kinds `centre`, `control` and `spec`. With `limits` the line of the station's limit is
 * that of each point, with an upright line where it changed. */
export function controlChart({ title, points, lines, limits = false, width, height = 240 }) {
  const shown = lines.filter((line) => line.value !== null && line.value !== undefined);
  const own = limits ? points.map((p) => p.limit) : [];
  const { picture, y, top, bottom } = frame({ title, width, height, below: 10, over: limits ? 26 : 10, role: "group" },
    [...points.map((p) => p.value), ...shown.map((line) => line.value), ...own]);
  const x = (i) => LEFT + 10 + (points.length < 2 ? 0.5 : i / (points.length - 1)) * (width - LEFT - 20);
  for (const { value, kind } of shown) picture.append(svg("line", { x1: LEFT, x2: width, y1: y(value), y2: y(value), class: kind }));
  if (limits) drawLimits(picture, own, { x, y, top, bottom, right: width });
  const drawn = points.map((p, i) => ({ ...p, i })).filter((p) => p.value !== null);
  picture.append(svg("path", { d: pathOf(drawn.map((p) => [x(p.i), y(p.value)])), class: "line" }));
  const size = points.length > 120 ? 2.2 : points.length > 60 ? 3 : 4;
  for (const p of drawn) {
    const [cx, cy] = [x(p.i), y(p.value)];
    const mark = svg("path", { d: MARKS[p.mark ?? "none"](cx, cy, size), class: `point ${p.mark ?? ""}` }, svg("title", {}, p.label));
    const beyond = p.beyond ? svg("path", { d: BEYOND(cx, cy - 8), class: "beyond" }, svg("title", {}, p.label)) : null;
    picture.append(...(p.href ? [linked(p.href, p.label, mark, beyond)] : [mark, beyond]).filter(Boolean));
  }
  return picture;
}

const APART_PX = 64;

/** The limit that each point had, and where it became another one, with the new one. */
function drawLimits(picture, own, { x, y, top, bottom, right }) {
  const half = (i) => (i === 0 ? LEFT : i === own.length ? right : (x(i - 1) + x(i)) / 2);
  let labelled = -APART_PX;
  for (let start = 0, end; start < own.length; start = end) {
    const limit = own[start];
    for (end = start + 1; end < own.length && own[end] === limit; ) end += 1;
    if (limit !== null) picture.append(svg("line", { x1: half(start), x2: half(end), y1: y(limit), y2: y(limit), class: "spec" }));
    if (start === 0) continue;
    const at = half(start);
    picture.append(svg("line", { x1: at, x2: at, y1: top - 8, y2: bottom, class: "change" }));
    if (at - labelled < APART_PX) continue;
    labelled = at;
    const left = at > right - APART_PX * 2;
    picture.append(svg("text", { x: at + (left ? -5 : 5), y: top - 6, class: "change", "text-anchor": left ? "end" : "start" },
      `${limit === null ? "–" : figure(limit, 4)}`));
  }
}

const MARKS = {
  none: (x, y, r) => `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`,
  outside: (x, y) => `M${x - 5} ${y - 5}h10v10h-10Z`,
  run: (x, y) => `M${x} ${y - 7}l7 7l-7 7l-7-7Z`,
};

const BEYOND = (x, y) => `M${x} ${y - 10}l6.5 10h-13Z`;

function linked(href, label, ...marks) {
  return svg("a", { href, "aria-label": label, tabindex: "-1" }, marks);
}

const pathOf = (points) => points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");

/** Values by name as bars, the largest first, with the cumulative share. `heads` are
 * the four heads of the columns. */
export function pareto({ bars, heads, href }) {
  const sorted = [...bars].sort((a, b) => b.count - a.count || (a.name < b.name ? -1 : 1));
  const total = sorted.reduce((sum, bar) => sum + bar.count, 0);
  let sum = 0;
  const rows = sorted.map((bar) => {
    sum += bar.count;
    const width = ((100 * bar.count) / sorted[0].count).toFixed(1);
    return element("tr", {},
      element("th", { scope: "row" }, element("a", { href: href(bar.name) }, bar.title)),
      element("td", { class: "bars" },
        svg("svg", { viewBox: "0 0 100 10", class: "chart", preserveAspectRatio: "none", "aria-hidden": "true" },
          svg("rect", { width, height: 10, class: "bar" }))),
      element("td", { class: "n" }, String(bar.count)),
      element("td", { class: "n" }, percent(sum / total)));
  });
  const [name, ...others] = heads;
  return element("table", { class: "pareto" },
    element("thead", {}, element("tr", {}, element("th", { scope: "col" }, name), element("td"),
      others.map((head) => element("th", { scope: "col", class: "n" }, head)))),
    element("tbody", {}, rows));
}

/** Readings of the three axes over time, with the spans of the poses. */
export function readingsChart({ title, t_s, readings, poses, time, width, height = 320 }) {
  const { picture, y, top, bottom } = frame({ title, width, height, below: 40 }, readings.flat());
  const [first, last] = [t_s[0], t_s[t_s.length - 1]];
  const x = (t) => LEFT + ((t - first) / (last - first || 1)) * (width - LEFT - 12);
  for (const [start, end] of poses) {
    picture.append(svg("rect", { x: x(start), width: Math.max(0.5, x(end) - x(start)), y: top, height: bottom - top, class: "span" }));
  }
  ["x", "y", "z"].forEach((axis, i) => {
    const points = t_s.map((t, k) => [t, readings[i][k]]).filter(([, v]) => v !== null);
    picture.append(svg("path", { d: pathOf(points.map(([t, v]) => [x(t), y(v)])), class: axis }),
      svg("text", { x: LEFT + 22 * i, y: bottom + 34, class: axis }, axis));
  });
  for (const t of ticks(first, last, width > 600 ? 8 : 4)) {
    picture.append(svg("text", { x: x(t), y: bottom + 18, "text-anchor": "middle" }, figure(t, 5)));
  }
  picture.append(svg("text", { x: width - 12, y: bottom + 34, "text-anchor": "end" }, time));
  return picture;
}
