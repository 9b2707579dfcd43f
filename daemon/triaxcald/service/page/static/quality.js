// How well the station works: yield, why runs do not pass, and figures over time.

import { amount, ask, characteristicName, element, failure, figure, meaning, percent, scaleOf, timeOf, word } from "./common.js";
import { controlChart, fitted, pareto } from "./chart.js";
import { asked, fillFilter } from "./results.js";

const PPK_LEAST = 30;
const content = document.getElementById("content");
fillFilter(document.getElementById("filter"));

function summary(q) {
  const shares = (share, n, interval) => (!interval ? "" : [
    word("quality.of", { passed: Math.round(share * n), n }),
    word("quality.interval", { low: percent(interval[0]), high: percent(interval[1]) }),
  ].join("; "));
  const rows = [
    ["quality.units", q.units.toLocaleString(), ""],
    ["quality.attempts", q.attempts.toLocaleString(), ""],
    ["quality.first_pass", percent(q.first_pass_yield), shares(q.first_pass_yield, q.first_pass_units, q.first_pass_yield_interval)],
    ["quality.yield", percent(q.yield), shares(q.yield, q.yield_units, q.yield_interval)],
  ];
  return element("dl", { class: "figures" }, rows.map(([key, value, more]) =>
    element("div", {}, element("dt", {}, word(key)), element("dd", {}, value, more ? element("small", {}, more) : null))));
}

function reasons(q) {
  const bars = Object.entries(q.codes).filter(([code, count]) => count && code !== "within_limits")
    .map(([name, count]) => ({ name, count, title: meaning(name) }));
  const filter = new URLSearchParams(location.search);
  const href = (code) => {
    filter.set("code", code);
    return `/runs?${filter}`;
  };
  return element("section", { class: "panel" }, element("h2", {}, word("quality.pareto")),
    bars.length
      ? element("div", { class: "wide" }, pareto({ bars, href, heads: [word("runs.code"), word("quality.count"), word("quality.share")] }))
      : element("p", { class: "muted" }, word("quality.pareto_none")));
}

function ppk(c) {
  if (c.low === null && c.high === null) return word("quality.ppk_no_limit");
  if (c.n < PPK_LEAST) return word("quality.ppk_few", { least: PPK_LEAST });
  if (c.ppk === null) return "–";
  const [low, high] = c.ppk_interval;
  return `${figure(c.ppk, 3)} (${figure(low, 3)}–${figure(high, 3)})`;
}

/** The limit, with a sign where it was another one for some of the units. */
function limitOf(c, told) {
  if (!c.limits_changed) return told(c.high);
  return element("span", { title: word("quality.limits_changed") }, `${told(c.high)} ⇅`);
}

function outsideOf({ outside }) {
  if (outside === null) return "–";
  return outside ? element("span", { class: "outside" }, `▲ ${outside}`) : "0";
}

/** What the limits say of a characteristic, in words. */
function limitsTold(c) {
  if (c.high === null && !c.limits_changed) return [];
  const told = [];
  if (c.outside !== null) {
    const given = { outside: c.outside, n: c.n, limit: amount(c.name, c.unit, c.high) };
    told.push(element("p", { class: `beside${c.outside ? " outside" : ""}`, "data-outside": c.outside },
      `${c.outside ? "▲ " : ""}${word("quality.outside_told", given)}`));
  }
  if (c.limits_changed) told.push(element("p", { class: "beside changed" }, `⇅ ${word("quality.limits_changed")}`));
  return told;
}

function characteristics(list, pick) {
  const heads = [["quality.characteristic"], ["quality.n", "n"], ["quality.mean", "n"], ["quality.sd", "n"], ["quality.low", "n"],
    ["quality.high", "n"], ["quality.outside", "n"], ["quality.ppk", "n"]];
  return element("section", { class: "panel" }, element("h2", {}, word("quality.characteristics")),
    element("div", { class: "wide" }, element("table", { class: "stack" },
      element("thead", {}, element("tr", {}, heads.map(([key, kind]) => element("th", { scope: "col", class: kind }, word(key))))),
      element("tbody", {}, list.map((c) => {
        const told = (value, digits) => amount(c.name, c.unit, value, digits);
        const cells = [String(c.n), told(c.mean), told(c.sd, 3), told(c.low), limitOf(c, told), outsideOf(c), ppk(c)];
        return element("tr", {},
          element("th", { scope: "row" }, element("button", { type: "button", class: "link name", onclick: () => pick(c.name) }, characteristicName(c.name))),
          cells.map((cell, i) => element("td", { class: "n", "data-label": word(heads[i + 1][0]) }, cell)));
      })))));
}

/** Individuals and moving ranges of a characteristic: a `triaxcal.chart/1`, and before
 * them what `c` of `triaxcal.quality/1` says of its limits. */
function charts(c, { name, unit: given, points, centre, low, high, mr_mean, mr_high, limit }) {
  if (points.length < 2) return [...limitsTold(c), element("p", { class: "muted" }, word("quality.few"))];
  const { factor, unit } = scaleOf(name, given);
  const scaled = (value) => (value === null ? null : value * factor);
  const title = (kind) => `${characteristicName(name)}${unit ? `, ${unit}` : ""}: ${word(kind)}`;
  const lines = (kinds) => Object.entries(kinds).flatMap(([kind, values]) => values.map((value) => ({ value: scaled(value), kind })));
  const marked = (point, value, mark) => ({
    value: scaled(value), mark, href: `/runs/${encodeURIComponent(point.run)}`,
    label: [point.serial, timeOf(point.time), amount(name, given, value, 5)].filter(Boolean).join(", "),
  });
  const told = (value) => amount(name, given, value, 4);
  const limited = points.some((point) => point.limit !== null);
  const ruled = ({ outside }) => (outside === "limits" ? "outside" : outside);
  return [
    ...limitsTold(c),
    fitted(title("quality.individuals"), (at) => controlChart({
      ...at, lines: lines({ centre: [centre], control: [low, high] }), limits: limited,
      points: points.map((point) => ({
        ...marked(point, point.value, ruled(point)), limit: scaled(point.limit), beyond: limit !== null && point.value > limit,
      })),
    })),
    fitted(title("quality.moving_range"), (at) => controlChart({
      ...at, lines: lines({ centre: [mr_mean], control: [mr_high] }), height: 180,
      points: points.map((point) => marked(point, point.moving_range, point.moving_range_outside ? "outside" : null)),
    })),
    element("p", { class: "control-told" }, word("quality.control_told", {
      mean: told(centre), low: told(low), high: told(high), mr_mean: told(mr_mean), mr_high: told(mr_high),
    })),
    element("p", { class: "muted" }, [word("quality.chart_note"), limited ? word("quality.chart_note_limit") : ""].join(" ").trim()),
  ];
}

try {
  const q = await ask(`/api/1/quality?${asked()}`);
  if (!q.attempts) content.replaceChildren(element("p", { class: "panel" }, word("quality.none")));
  else {
    const list = q.characteristics;
    const place = element("div");
    const choice = element("select", { id: "characteristic" }, list.map((c) => element("option", { value: c.name }, characteristicName(c.name))));
    const show = async () => {
      const name = choice.value;
      let drawn;
      try {
        drawn = charts(list.find((c) => c.name === name), await ask(`/api/1/charts?${asked(["name", name])}`));
      } catch (error) {
        drawn = [failure(error)];
      }
      if (name === choice.value) place.replaceChildren(...drawn);
    };
    const pick = (name) => {
      choice.value = name;
      show();
      choice.scrollIntoView({ block: "nearest" });
      choice.focus();
    };
    choice.addEventListener("change", show);
    content.replaceChildren(...[
      summary(q), element("p", { class: "muted" }, word("quality.one_value")), reasons(q),
      list.length ? element("section", { class: "panel" },
        element("div", { class: "pick" }, element("label", { for: "characteristic" }, word("quality.chart")), choice), place) : null,
      list.length ? characteristics(list, pick) : null,
    ].filter(Boolean));
    if (list.length) await show();
  }
} catch (error) {
  content.replaceChildren(failure(error));
}
content.removeAttribute("aria-busy");
const csv = document.getElementById("csv");
csv.href = `/api/1/runs.csv?${asked()}`;
