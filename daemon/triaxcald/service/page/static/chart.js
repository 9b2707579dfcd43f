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

/** Axes for the values; `below` is the room for what stands under them. */
function frame({ title, width, height, below, role = "img" }, values) {
  const seen = sure(values);
  let [low, high] = [Math.min(...seen), Math.max(...seen)];
  const margin = (high - low || Math.abs(high) * 0.1 || 1) * 0.07;
  [low, high] = [low - margin, high + margin];
  const [top, bottom] = [10, height - below];
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

/** A control chart: `points` [{value, label, href, mark}] in their
 * order, `mark` null, `outside` (a square) or `run` (a diamond), `lines`
 * [{value, kind}] of the kinds `centre`, `control` and `spec`. */
export function controlChart({ title, points, lines, width, height = 240 }) {
  const shown = lines.filter((line) => line.value !== null && line.value !== undefined);
  const { picture, y } = frame({ title, width, height, below: 10, role: "group" }, [...points.map((p) => p.value), ...shown.map((line) => line.value)]);
  const x = (i) => LEFT + 10 + (points.length < 2 ? 0.5 : i / (points.length - 1)) * (width - LEFT - 20);
  for (const { value, kind } of shown) picture.append(svg("line", { x1: LEFT, x2: width, y1: y(value), y2: y(value), class: kind }));
  const drawn = points.map((p, i) => ({ ...p, i })).filter((p) => p.value !== null);
  picture.append(svg("path", { d: pathOf(drawn.map((p) => [x(p.i), y(p.value)])), class: "line" }));
  const size = points.length > 120 ? 2.2 : points.length > 60 ? 3 : 4;
  for (const p of drawn) {
    const [cx, cy] = [x(p.i), y(p.value)];
    const mark = svg("path", { d: MARKS[p.mark ?? "none"](cx, cy, size), class: `point ${p.mark ?? ""}` }, svg("title", {}, p.label));
    picture.append(p.href ? linked(p.href, p.label, mark) : mark);
  }
  return picture;
}

const MARKS = {
  none: (x, y, r) => `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`,
  outside: (x, y) => `M${x - 5} ${y - 5}h10v10h-10Z`,
  run: (x, y) => `M${x} ${y - 7}l7 7l-7 7l-7-7Z`,
};

function linked(href, label, mark) {
  return svg("a", { href, "aria-label": label, tabindex: "-1" }, mark);
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
