// The full history of a unit.

import { amount, ask, element, failure, page, scaleOf, timeOf, word } from "./common.js";
import { controlChart, fitted } from "./chart.js";
import { COEFFICIENTS, runsTable } from "./results.js";

const content = document.getElementById("content");

/** A figure over the runs that measured it. */
function overRuns(runs, { name, title, unit, limit }) {
  const scale = scaleOf(name, unit);
  const known = (value) => value !== null && value !== undefined;
  const points = runs.filter((run) => known(run[name])).map((run) => ({
    value: run[name] * scale.factor,
    label: `${timeOf(run.ended)}: ${amount(name, unit, run[name], 5)}`,
    href: `/runs/${encodeURIComponent(run.run)}`,
    mark: known(run[limit]) && run[name] > run[limit] ? "outside" : null,
  }));
  if (points.length < 2) return null;
  const limits = runs.map((run) => run[limit]).filter(known);
  const lines = limits.length ? [{ value: limits[limits.length - 1] * scale.factor, kind: "spec" }] : [];
  return fitted(scale.unit ? `${title}, ${scale.unit}` : title, (given) => controlChart({ ...given, points, lines, height: 160 }));
}

try {
  const { runs } = await ask(`/api/1/units/${encodeURIComponent(page.serial)}`);
  const newest = [...runs].sort((a, b) => (a.ended < b.ended ? 1 : -1));
  if (!runs.length) content.replaceChildren(element("p", { class: "panel" }, word("unit.none")));
  else {
    const errors = ["rms_g", "cross_validated_rms_g", "verification_rms_g"]
      .map((name) => ({ name, unit: "g", title: word(`figure.${name}`), limit: name.replace(/_g$/, "_limit_g") }));
    const charts = [...errors, ...COEFFICIENTS].map((what) => overRuns([...newest].reverse(), what)).filter(Boolean);
    content.replaceChildren(
      element("h2", {}, word("unit.history")), runsTable(newest, { history: true }),
      element("h2", {}, word("unit.over_runs")),
      charts.length ? element("div", { class: "two" }, charts.map((chart) => element("div", { class: "panel" }, chart)))
        : element("p", { class: "muted" }, word("unit.short")));
  }
} catch (error) {
  content.replaceChildren(failure(error));
}
content.removeAttribute("aria-busy");
