// What the pages of results share: the filter, and a table of runs.

import { characteristicName, element, meaning, microG, runLink, timeOf, unitLink, verdictTag, word } from "./common.js";

const TIMES = ["since", "until"];

/** Fills the form from the address, and says what it asks for: on paper the form is not
 * shown. */
export function fillFilter(form) {
  const told = [];
  for (const [key, value] of new URLSearchParams(location.search)) {
    const field = form.elements.namedItem(key);
    if (!field || !value) continue;
    field.value = TIMES.includes(key) ? localTime(value) : value;
    const shown = field.selectedOptions?.[0]?.textContent ?? field.value.replace("T", " ");
    if (shown) told.push(`${field.labels[0].firstChild.textContent}: ${shown}`);
  }
  document.getElementById("filtered").textContent = told.join("; ");
  if (matchMedia("(max-width: 36rem)").matches) form.closest("details").open = false;
  // What is empty asks for nothing: it stays out of the address.
  form.addEventListener("submit", (e) => {
    e.preventDefault();
    const given = [...new FormData(form)].map(([key, value]) => [key, String(value).trim()]).filter(([, value]) => value);
    location.search = new URLSearchParams(given).toString();
  });
}

/** A time of the address as a field for local times takes it. */
function localTime(text) {
  const time = new Date(text);
  if (!/Z|[+-]\d\d:?\d\d$/.test(text) || Number.isNaN(time.getTime())) return text;
  return new Date(time.getTime() - 60000 * time.getTimezoneOffset()).toISOString().slice(0, 16);
}

/** What the address asks for, as the interface takes it: times in UTC. */
export function asked(...more) {
  const query = new URLSearchParams();
  for (const [key, value] of new URLSearchParams(location.search)) {
    if (["lang", "theme"].includes(key) || !value) continue;
    const time = TIMES.includes(key) ? new Date(value) : null;
    query.set(key, time && !Number.isNaN(time.getTime()) ? time.toISOString() : value);
  }
  for (const [key, value] of more) query.set(key, value);
  return query;
}

/** Runs as rows: of several units, or the history of one, which also has the reasons in
 * full. */
export function runsTable(runs, { history = false } = {}) {
  const columns = [
    ["runs.ended", (r) => runLink(r.run, timeOf(r.ended)), "time"],
    history ? null : ["card.serial", (r) => unitLink(r.serial ?? r.work_serial)],
    ["runs.verdict", (r) => verdictTag(r.verdict)],
    ["runs.code", (r) => why(r, history), "text"],
    ["runs.error", (r) => errorOf(r), "n"],
    ["card.slot", (r) => r.slot ?? r.unit],
    ["runs.attempt", (r) => r.attempt ?? "–", "n"],
    history ? ["work.reason", (r) => r.work_reason ?? "–", "text"] : null,
    ["work.order", (r) => r.order ?? "–"],
    ["work.part_number", (r) => r.part_number ?? "–"],
    ["work.fixture", (r) => r.fixture ?? "–"],
    ["work.operator", (r) => r.operator ?? "–"],
  ].filter(Boolean);
  return element("div", { class: "panel wide" },
    element("table", { class: "stack" },
      element("thead", {}, element("tr", {}, columns.map(([key, , kind]) => element("th", { scope: "col", class: kind }, word(key))))),
      element("tbody", {}, runs.map((run) =>
        element("tr", {}, columns.map(([key, cell, kind]) => element("td", { class: kind, "data-label": word(key) }, cell(run))))))));
}

function why({ code, reason }, history) {
  if (!code) return reason;
  if (!history || code === "within_limits") return element("span", { title: reason }, meaning(code));
  return element("div", {}, meaning(code), element("small", { class: "detail" }, reason));
}

function errorOf(run) {
  const [value, limit] = [run.verification_rms_g, run.verification_rms_limit_g];
  const outside = value !== null && limit !== null && value > limit;
  return outside ? element("span", { class: "outside" }, `▲ ${microG(value)}`) : microG(value);
}

/** Names of the characteristics that a row of `triaxcal.results/1` has, with units. */
export const COEFFICIENTS = [["scale_factor", ""], ["misalignment", "rad"], ["bias", "g"]]
  .flatMap(([name, unit]) => ["x", "y", "z"].map((axis) => ({ name: `${name}_${axis}`, unit, title: characteristicName(`${name}_${axis}`) })));
