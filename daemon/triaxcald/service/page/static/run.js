// One run: verdict, figures, documents, the recording as a picture, its events.

import {
  ask, clockOf, element, failure, figure, icon, ICONS, meaning, microG, page, Refused, runLink, scaleOf, timeOf, unitLink, word, wordOr,
} from "./common.js";
import { fitted, readingsChart } from "./chart.js";
import { describedPose, OWN_NAMES } from "./pose.js";
import { COEFFICIENTS } from "./results.js";

const content = document.getElementById("content");
const address = `/api/1/runs/${encodeURIComponent(page.run)}`;

const panel = (title, ...children) => element("section", { class: "panel" }, element("h2", {}, title), children);

function banner(run) {
  return element("div", { class: `banner ${run.verdict}` },
    element("p", { class: "word" }, ICONS[run.verdict] ? icon(run.verdict) : null, wordOr(`verdict.${run.verdict}`, run.verdict)),
    element("div", {}, element("strong", {}, run.code ? meaning(run.code) : run.reason), run.code ? element("p", {}, run.reason) : null));
}

function facts(run) {
  const duration = run.duration_s === null || run.duration_s === undefined ? "–" : `${figure(run.duration_s, 4)} s`;
  const rows = [
    ["card.serial", unitLink(run.serial ?? run.work_serial)],
    ["card.slot", run.slot ?? run.unit],
    ["runs.attempt", run.attempt],
    ["work.operator", run.operator],
    ["work.order", run.order],
    ["work.batch", run.batch],
    ["work.part_number", run.part_number],
    ["work.fixture", run.fixture],
    ["work.reason", run.work_reason],
    ["run.started", timeOf(run.started)],
    ["run.duration", duration],
    ["run.settles", run.settles ? runLink(run.settles, word("run.settles_link")) : null],
    ["run.device_state", wordOr(`device.${run.device_state}`, run.device_state)],
    ["card.poses", run.poses],
    ["run.terms", run.terms?.length ? run.terms.join(", ").replaceAll("_", " ") : null],
  ].filter(([, value]) => value !== null && value !== undefined);
  return panel(word("run.facts"), element("dl", { class: "facts" },
    rows.map(([key, value]) => element("div", {}, element("dt", {}, word(key)), element("dd", {}, value)))));
}

function papers(run) {
  const link = (key, path, attributes = {}) => element("a", { class: "button", href: `${address}/${path}`, ...attributes }, word(key));
  const lacking = [["report", "run.report"], ["certificate", "run.certificate"], ["recording", "run.recording"]]
    .filter(([name]) => !run[name]).map(([, key]) => word(key));
  return panel(word("run.papers"), element("div", { class: "papers" },
    run.report ? link("run.report", "report", { target: "_blank" }) : null,
    run.certificate ? link("run.certificate", "certificate", { download: true }) : null,
    link("run.outcome", "outcome", { target: "_blank" }),
    run.recording ? link("run.recording", "recording", { download: true }) : null),
  lacking.length ? element("p", { class: "muted lacking" }, word("run.lacking", { names: lacking.join(", ") })) : null);
}

function errors(run) {
  const rows = ["rms", "cross_validated_rms", "verification_rms"].filter((name) => run[`${name}_g`] !== null).map((name) => {
    const [before, value, limit] = [run[`${name}_before_g`], run[`${name}_g`], run[`${name}_limit_g`]];
    const outside = limit !== null && value > limit;
    return element("tr", {},
      element("th", { scope: "row" }, word(`figure.${name}_g`)),
      element("td", { class: "n" }, microG(before)),
      element("td", { class: `n${outside ? " outside" : ""}` }, `${outside ? "▲ " : ""}${microG(value)}`),
      element("td", { class: "n" }, microG(limit)));
  });
  if (!rows.length) return null;
  return panel(word("run.errors"), table(["run.quantity", "run.before", "run.after", "run.limit"], rows));
}

function coefficients(run) {
  const rows = COEFFICIENTS.filter(({ name }) => run[name] !== null && run[name] !== undefined).map(({ name, title, unit }) =>
    element("tr", {},
      element("th", { scope: "row" }, title),
      element("td", { class: "n" }, figure(run[name] * scaleOf(name, unit).factor, 6)),
      element("td", { class: "n" }, errorOf(run, name, unit)),
      element("td", { class: "n" }, scaleOf(name, unit).unit || "–")));
  if (!rows.length) return null;
  return panel(word("run.coefficients"), table(["run.quantity", "run.value", "run.standard_error", "run.unit"], rows));
}

function beside(...panels) {
  return panels.some(Boolean) ? element("div", { class: "two" }, panels) : null;
}

function errorOf(run, name, unit) {
  const error = run[`${name}_standard_error`];
  return error === null || error === undefined ? "–" : figure(error * scaleOf(name, unit).factor, 2);
}

function table(heads, rows) {
  return element("div", { class: "wide" }, element("table", {},
    element("thead", {}, element("tr", {}, heads.map((key, i) => element("th", { scope: "col", class: i ? "n" : null }, word(key))))),
    element("tbody", {}, rows)));
}

function told(event) {
  switch (event.event) {
    case "stage":
      return wordOr(`stage.${event.stage}`, event.stage);
    case "poses": {
      const count = word("card.pose", { found: event.found, wanted: event.wanted });
      if (!event.next) return count;
      const { pose, tilt } = describedPose(event.next.vector, OWN_NAMES);
      return `${count}. ${word("card.next")}: ${[pose, tilt].filter(Boolean).join(", ")}`;
    }
    case "lost":
      return `${word("run.event_lost")}: ${event.reason}`;
    case "back":
      return word("run.event_back");
    case "ended":
      return `${word("run.event_ended")}: ${wordOr(`verdict.${event.outcome.verdict}`, event.outcome.verdict)}`;
    default:
      return event.event;
  }
}

function events(list) {
  if (!list.length) return element("p", { class: "muted" }, word("run.no_events"));
  return element("div", { class: "wide" }, element("table", {}, element("tbody", {},
    list.map((event) => element("tr", {}, element("td", { class: "time" }, clockOf(event.time)), element("td", {}, told(event)))))));
}

async function trace(place, recording) {
  try {
    const found = await ask(`/runs/${encodeURIComponent(page.run)}/trace`, { patience_ms: 60000 });
    place.replaceChildren(
      fitted(`${word("run.trace")}, ${found.unit}`, (given) => readingsChart({ ...found, ...given, time: word("run.time_s") })),
      element("p", { class: "muted" }, word("run.trace_note")));
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    place.replaceChildren(element("p", { class: "muted" }, word(recording ? "run.short_trace" : "run.no_trace")));
  }
}

try {
  const run = await ask(address);
  const serial = run.serial ?? run.work_serial ?? "–";
  document.title = `${word("run.title", { serial })} · ${page.station}`;
  const picture = element("div", {}, element("p", { class: "muted" }, word("page.loading")));
  content.replaceChildren(...[
    element("h1", {}, word("run.title", { serial })), banner(run), facts(run), papers(run),
    beside(errors(run), coefficients(run)),
    element("section", { class: "panel", "aria-label": word("run.trace") }, picture), panel(word("run.events"), events(run.events ?? [])),
  ].filter(Boolean));
  content.removeAttribute("aria-busy");
  await trace(picture, run.recording);
} catch (error) {
  content.replaceChildren(failure(error));
  content.removeAttribute("aria-busy");
}
