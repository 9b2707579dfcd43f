// What all pages share: words, requests, figures, and building elements from text.

export const page = JSON.parse(document.body.dataset.page);

/** The text of an entry of words.toml, with its {…} filled in. */
export function word(key, given = {}) {
  const text = page.words[key];
  if (text === undefined) throw new Error(`no word ${key}`);
  return text.replace(/\{(\w+)\}/g, (whole, name) => (name in given ? String(given[name]) : whole));
}

/** The text of an entry that may be missing: of a code that a later version knows. */
export const wordOr = (key, otherwise) => page.words[key] ?? otherwise;

/** An element; its text is always text, never markup. */
export function element(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

export function svg(tag, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function filled(made, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return made;
}

/** Why a request was refused: `code` and `message` of the interface. */
export class Refused extends Error {
  constructor(code, message) {
    super(message);
    this.code = code;
  }
}

/** The document that the interface answers. Throws Refused. */
export async function ask(path, { method = "GET", body, patience_ms = 15000 } = {}) {
  let answer;
  try {
    answer = await fetch(path, {
      method,
      headers: method === "GET" ? {} : { "Content-Type": "application/json" },
      body: method === "GET" ? undefined : JSON.stringify(body ?? {}),
      cache: "no-store",
      credentials: "same-origin",
      signal: AbortSignal.timeout(patience_ms),
    });
  } catch {
    throw new Refused("no_answer", "");
  }
  const document = await answer.json().catch(() => null);
  if (answer.ok) return document;
  throw new Refused(document?.code ?? (answer.status === 401 ? "not_signed_in" : "invalid"), document?.message ?? "");
}

/** What happened and what to do about it, in words. */
export function explained(refused) {
  return {
    title: wordOr(`problem.${refused.code}`, refused.message || refused.code),
    advice: wordOr(`problem.${refused.code}_do`, ""),
    detail: refused.message ?? "",
  };
}

/** To the sign-in, and back here from there. */
export function signIn() {
  location.assign(`/sign-in?next=${encodeURIComponent(location.pathname + location.search)}`);
}

/** In place of what could not be loaded. */
export function failure(error) {
  if (!(error instanceof Refused)) throw error;
  if (error.code === "not_signed_in") signIn();
  const { title, advice, detail } = explained(error);
  return element("div", { class: "alarm error", role: "alert" },
    element("div", {}, element("strong", {}, title), element("span", {}, advice), element("small", {}, detail)));
}

const locale = page.language === "en" ? "en-GB" : page.language;
const times = new Intl.DateTimeFormat(locale, { dateStyle: "medium", timeStyle: "short" });
const clock = new Intl.DateTimeFormat(locale, { timeStyle: "medium" });

export const timeOf = (text) => (text ? times.format(new Date(text)) : "–");
export const clockOf = (text) => clock.format(text === undefined ? new Date() : new Date(text));

/** A figure with so many significant digits. */
export function figure(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size === 0 || (size >= 1e-4 && size < 1e7)) return signed(value.toLocaleString(locale, { maximumSignificantDigits: digits }));
  const [mantissa, power] = value.toExponential(digits - 1).split("e");
  return `${signed(Number(mantissa).toLocaleString(locale, { maximumFractionDigits: digits - 1 }))} × 10${raised(Number(power))}`;
}

const signed = (text) => text.replace("-", "−");
const raised = (power) => [...String(power)].map((c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]).join("");

export const decimal = (value, places) =>
  value.toLocaleString(locale, { minimumFractionDigits: places, maximumFractionDigits: places });

/** An error of the magnitude, given in g. */
export const microG = (value) => (value === null || value === undefined ? "–" : `${figure(value * 1e6, 3)} µg`);

export const percent = (share) =>
  share === null || share === undefined ? "–" : share.toLocaleString(locale, { style: "percent", maximumFractionDigits: 1 });

export const ICONS = {
  pass: "M5 12.5 10 17.5 19.5 6.5",
  fail: "M6 6 18 18M18 6 6 18",
  aborted: "M7 7h10v10H7Z",
  not_judged: "M5 12h14",
};

export function icon(name) {
  return svg("svg", { viewBox: "0 0 24 24", "aria-hidden": "true", class: `icon ${name}` }, svg("path", { d: ICONS[name] }));
}

/** The verdict as sign and word. */
export const verdictTag = (verdict) =>
  element("span", { class: `verdict ${verdict}` }, ICONS[verdict] ? icon(verdict) : null, wordOr(`verdict.${verdict}`, verdict));

/** What a code means, for people. */
export const meaning = (code) => wordOr(`code.${code}`, code ?? "");

const AXES = ["x", "y", "z"];

/** The name of a characteristic, as the interface has it, for people. */
export function characteristicName(name) {
  const axis = AXES.find((a) => name.endsWith(`_${a}`));
  const base = axis ? name.slice(0, -2) : name;
  const text = wordOr(`figure.${base}`, name);
  return axis ? text.replace("{axis}", axis) : text;
}

/** How a characteristic is shown: `factor` from the interface's unit to `unit`. */
export function scaleOf(name, unit) {
  if (name.endsWith("rms_g")) return { factor: 1e6, unit: "µg" };
  if (name.startsWith("bias")) return { factor: 1e3, unit: "mg" };
  if (name.startsWith("misalignment")) return { factor: 1e3, unit: "mrad" };
  return { factor: 1, unit: unit ?? "" };
}

/** A value of a characteristic with its unit. */
export function amount(name, unit, value, digits = 4) {
  if (value === null || value === undefined) return "–";
  const scale = scaleOf(name, unit);
  return `${figure(value * scale.factor, digits)}${scale.unit ? ` ${scale.unit}` : ""}`;
}

export const runLink = (run, text) => element("a", { href: `/runs/${encodeURIComponent(run)}` }, text);
export const unitLink = (serial) =>
  serial ? element("a", { href: `/units/${encodeURIComponent(serial)}` }, serial) : "–";

document.getElementById("sign-out")?.addEventListener("click", async () => {
  await ask("/api/1/session", { method: "DELETE" }).catch(() => null);
  location.reload();
});
for (const menu of document.querySelectorAll("details.settings")) {
  document.addEventListener("click", (e) => menu.contains(e.target) || menu.removeAttribute("open"));
  menu.addEventListener("keydown", (e) => e.key === "Escape" && menu.removeAttribute("open"));
}
