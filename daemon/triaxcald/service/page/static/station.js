// The operator's page: what to do now, how each slot stands, and the verdicts. All of it
// is drawn from the station's event stream; what people scan and press goes to the
// interface, and is shown when the stream tells of it.

import { ask, clockOf, decimal, element, explained, icon, meaning, page, Refused, runLink, word, wordOr } from "./common.js";
import { barcodePicture, cubePicture, describedPose, spherePicture, supplyPicture } from "./pose.js";
import { atWork, Following, VERDICTS } from "./state.js";

const at = (id) => document.getElementById(id);
const COLLECTING = ["poses", "check_poses"];
let state = null;
let live = {};

// Who works: whose badge was scanned, else who has signed in here.
const operatorOf = (now) => now.operator ?? page.person;

// What to do.

/** The tasks at hand, the most urgent first: `title`, and `more`, `slots`, `up`,
 * `supply`, `tone`. */
function tasksOf(now) {
  const slots = now.slots;
  const named = (list) => list.map((s) => s.slot);
  const working = slots.filter(atWork);
  if (working.length) return tasksAtWork(now, working, named);
  const ended = slots.filter((s) => s.state in VERDICTS);
  if (ended.length) {
    const counted = Object.entries(VERDICTS)
      .map(([is, verdict]) => [ended.filter((s) => s.state === is).length, verdict])
      .filter(([n]) => n)
      .map(([n, verdict]) => `${n} ${word(`verdict.${verdict}`)}`.replaceAll(" ", "\u00a0"));
    return [...blockedTask(now), { title: word("task.done"), more: `${counted.join(", ")}. ${word("task.done_more")}` }];
  }
  if (page.operator && !operatorOf(now)) return [{ title: word("task.badge"), more: word("task.badge_more"), scan: true }, ...blockedTask(now)];
  const empty = slots.filter((s) => s.state === "empty");
  const filled = slots.length - empty.length;
  const chosen = slots.find((s) => s.slot === now.chosen);
  const task = chosen
    ? { title: word("task.scan_chosen", { slot: chosen.slot }), more: chosenMore(chosen), scan: true }
    : !filled
    ? { title: word("task.scan_first"), more: word("task.scan_first_more", { slot: slots[0]?.slot ?? "" }), scan: true }
    : empty.length
      ? { title: word("task.scan_next"), more: word("task.scan_next_more", { filled, slots: slots.length, slot: empty[0].slot }), scan: true }
      : { title: word("task.start"), more: word("task.start_more") };
  // A tray whose start is refused is not to be started.
  const refused = now.blocked && !chosen && filled > 0 && !empty.length;
  return [...blockedTask(now), ...(refused ? [] : [task])];
}

function chosenMore({ slot, serial }) {
  const replaced = serial ? word("task.scan_chosen_replaces", { serial: whole(serial) }) : "";
  return [word("task.scan_chosen_more", { slot }), replaced].filter(Boolean).join(" ");
}

/** A serial number that no line break parts. */
const whole = (serial) => serial.replaceAll("-", "\u2011").replaceAll(" ", "\u00a0");

/** Whether the code is of a slot that waits for the golden unit. */
const ofGolden = (code) => page.golden !== null && ["golden_due", "golden_failed"].includes(code);

function blockedTask(now) {
  if (!now.blocked) return [];
  const these = now.slots.filter((s) => s.blocked).map((s) => s.slot);
  if (ofGolden(now.blocked) && these.length) {
    const more = [word("task.golden_more", { serial: whole(page.golden), slot: these[0] })];
    if (these.length > 1) more.push(word("task.golden_each", { slots: these.join(", ") }));
    return [{ title: word("task.golden"), more: more.join(" "), tone: "warn" }];
  }
  const more = [wordOr(`problem.${now.blocked}`, now.blocked), wordOr(`problem.${now.blocked}_do`, "")].join(" ");
  return [{ title: word("task.blocked"), more, tone: "warn" }];
}

function tasksAtWork(now, working, named) {
  const tasks = [];
  const running = working.filter((s) => s.state === "running");
  for (const [stage, on] of [["power_off", false], ["power_on", true]]) {
    const these = running.filter((s) => s.stage === stage);
    if (these.length) tasks.push({ title: word(`task.${stage}`), slots: named(these), supply: on ? "on" : "off", tone: "act" });
  }
  const instruction = instructionOf(now, working);
  if (instruction) {
    const { pose, tilt } = describedPose(instruction.vector, page.faces);
    const these = running.filter((s) => COLLECTING.includes(s.stage) && instruction.slots.includes(s.slot));
    const once_more = these.length > 0 && these.every((s) => s.next?.once_more);
    tasks.push({
      title: pose, tilt, up: instruction.vector, slots: named(these), tone: "act",
      more: once_more ? word("task.once_more") : "",
    });
  } else if (running.some((s) => COLLECTING.includes(s.stage) && s.wanted > 0)) {
    const one = working.length === 1 || page.together;
    tasks.push({ title: word(one ? "task.any_pose" : "task.turn_each"), tone: "act" });
  }
  const lost = working.filter((s) => s.state === "lost");
  if (lost.length) tasks.push({ title: word("task.lost", { slots: named(lost).join(", ") }), more: word("task.lost_more"), tone: "warn" });
  if (!tasks.length) {
    const stages = [...new Set(running.map((s) => s.stage))].filter(Boolean).map((s) => wordOr(`stage.${s}`, s));
    tasks.push({ title: word("task.wait"), more: stages.join(", "), tone: "wait" });
  }
  return tasks;
}

/** The pose that the fixture takes next, or the only unit at work. */
function instructionOf(now, working) {
  const collecting = working.filter((s) => s.state === "running" && COLLECTING.includes(s.stage));
  if (page.together) {
    const wanted = now.instruction;
    return wanted && collecting.some((s) => wanted.slots.includes(s.slot)) ? wanted : null;
  }
  const only = working.length === 1 && collecting.length === 1 ? collecting[0] : null;
  return only?.next ? { vector: only.next.vector, slots: [only.slot] } : null;
}

/** Sets a text, and announces it, only if it is another one. */
function tell(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

let drawn = "";

function showTask(tasks) {
  const [first, ...others] = tasks;
  const node = at("task");
  node.className = `task ${first.tone ?? ""}`;
  const several = page.slots.length > 1 && first.slots?.length && first.slots.length < page.slots.length;
  tell(at("task-for"), several ? word("task.for_slots", { slots: first.slots.join(", ") }) : "");
  const title = at("task-title");
  tell(title, first.title);
  title.className = first.title.length > 34 ? "long" : first.title.length > 20 ? "middle" : "";
  tell(at("task-more"), [first.tilt, first.more].filter(Boolean).join(". "));
  const picture = JSON.stringify([first.up, first.supply, first.scan]);
  if (picture !== drawn) {
    drawn = picture;
    const made = pictureOf(first);
    at("drawing").replaceChildren(...(made ? [made] : []));
    at("drawing").hidden = !made;
  }
  at("also").replaceChildren(
    ...others.map((task) => {
      const where = task.slots?.length ? `${word("task.for_slots", { slots: task.slots.join(", ") })}: ` : "";
      const rest = [task.tilt, task.more].filter(Boolean).join(". ");
      return element("li", { class: task.tone ?? "" }, element("strong", {}, `${where}${task.title}`), rest ? ` ${rest}` : null);
    }));
  showStillOf(first);
}

function pictureOf(task) {
  if (task.up) return cubePicture(task.up, page.faces, word("pose.drawing", { pose: [task.title, task.tilt].filter(Boolean).join(", ") }));
  if (task.supply) return supplyPicture(task.supply === "on", task.title);
  return task.scan ? barcodePicture() : null;
}

/** How long the tray has been still, of the slots that the task is for. */
function showStillOf(task) {
  const these = task.up ? (task.slots ?? []).map((slot) => live[slot]).filter(Boolean) : [];
  at("still").hidden = !these.length;
  if (!these.length) return;
  const least = these.reduce((a, b) => (b.held_s / b.hold_s < a.held_s / a.hold_s ? b : a));
  fillStill(at("still"), least);
}

function fillStill(node, { held_s, hold_s }) {
  const share = hold_s ? Math.min(1, held_s / hold_s) : 0;
  node.querySelector("i").style.width = `${(100 * share).toFixed(1)}%`;
  const text = held_s > 0 ? word("card.still", { held: decimal(Math.min(held_s, hold_s), 1), hold: decimal(hold_s, 1) }) : word("card.moving");
  tell(node.querySelector("span"), text);
}

// The slots.

const cards = new Map();

function cardOf(slot) {
  if (!cards.has(slot)) {
    const node = element("article", { class: "card", "aria-label": `${word("card.slot")} ${slot}` });
    cards.set(slot, { node, shown: "" });
    resized.observe(node);
  }
  return cards.get(slot);
}

function showCards(now) {
  const nodes = now.slots.map((slot) => {
    const card = cardOf(slot.slot);
    const chosen = slot.slot === now.chosen;
    const shown = JSON.stringify([slot, chosen]);
    if (shown !== card.shown) {
      card.shown = shown;
      showCard(card.node, slot, chosen);
    }
    return card.node;
  });
  const holder = at("cards");
  if (nodes.length !== holder.children.length || nodes.some((node, i) => holder.children[i] !== node)) holder.replaceChildren(...nodes);
  holder.dataset.slots = nodes.length > 6 ? "many" : nodes.length > 2 ? "some" : "few";
}

/** Whether each unit has a pose of its own to take: several, and no fixture. */
const turnedAlone = () => !page.together && page.slots.length > 1;

/** Why the slot does not start, and what to do. */
function blockedNote({ blocked }) {
  const golden = ofGolden(blocked);
  const why = wordOr(`problem.${blocked}`, meaning(blocked));
  const advice = golden ? word("card.golden_do", { serial: whole(page.golden) }) : wordOr(`problem.${blocked}_do`, "");
  return element("div", { class: "blocked-note", "data-code": blocked }, 
    element("p", { class: "stage" }, word("card.blocked")), element("strong", {}, why), element("p", {}, advice));
}

function showCard(node, slot, chosen) {
  const verdict = VERDICTS[slot.state];
  node.className = ["card", slot.state, chosen ? "chosen" : "", slot.blocked ? "blocked" : ""].filter(Boolean).join(" ");
  const head = element("header", {},
    element("span", { class: "slot" }, slot.slot),
    element("span", { class: "serial" }, slot.serial ?? ""),
    atWork(slot) ? stopButton(slot.slot) : null);
  if (verdict) {
    const sentence = slot.code ? meaning(slot.code) : slot.reason ?? "";
    node.replaceChildren(...[head,
      element("p", { class: "big" }, element("span", {}, icon(verdict), element("b", {}, word(`verdict.${verdict}`)))),
      element("p", { class: "why" }, sentence),
      slot.code && slot.reason && slot.code !== "within_limits" ? element("p", { class: "detail" }, slot.reason) : null,
      slot.run ? element("p", { class: "link" }, runLink(slot.run, word("card.details"))) : null].filter(Boolean));
    fitVerdict(node);
    return;
  }
  const body = element("div", { class: "body" });
  const told = element("div", { class: "told" });
  if (slot.blocked) told.append(blockedNote(slot));
  else told.append(element("p", { class: "stage" }, slot.stage && slot.state === "running" ? wordOr(`stage.${slot.stage}`, slot.stage) : word(`state.${slot.state}`)));
  if (chosen) told.prepend(element("p", { class: "chosen-note" }, word("card.chosen")));
  if (slot.state === "lost") told.append(element("p", { class: "why" }, slot.code ? meaning(slot.code) : ""), element("p", { class: "detail" }, slot.reason ?? ""));
  if (atWork(slot) && COLLECTING.includes(slot.stage)) {
    const key = slot.stage === "poses" ? "card.pose" : "card.check_pose";
    if (slot.wanted) {
      told.append(element("p", { class: "count" }, word(key, { found: slot.found, wanted: slot.wanted })),
        element("progress", { max: slot.wanted, value: Math.min(slot.found, slot.wanted), "aria-label": word("card.poses") }));
    }
    if (slot.next && turnedAlone()) {
      const { pose, tilt } = describedPose(slot.next.vector, page.faces);
      const said = [pose, tilt].filter(Boolean).join(", ");
      told.append(element("p", { class: "next" }, `${word("card.next")}: ${said}`));
      body.append(element("div", { class: "turn" }, cubePicture(slot.next.vector, page.faces, word("pose.drawing", { pose: said }))));
    }
    if (slot.state === "running") told.append(element("div", { class: "still", hidden: true }, element("div", { class: "bar" }, element("i")), element("span")));
    body.prepend(told);
    body.append(element("div", { class: "ball" }));
  } else body.append(told);
  node.replaceChildren(head, body);
  showLive(slot);
}

const VERDICT_PX = 160;

/** The verdict as large as the card is wide, in whatever language and font. */
function fitVerdict(node) {
  const big = node.querySelector(".big");
  if (!big?.clientWidth) return;
  big.style.fontSize = "100px";
  const width = big.firstElementChild.offsetWidth;
  big.style.fontSize = `${Math.min(VERDICT_PX, Math.floor((100 * big.clientWidth) / width))}px`;
}

const resized = new ResizeObserver((entries) => entries.forEach((entry) => fitVerdict(entry.target)));

function stopButton(slot) {
  return element("button", { type: "button", class: "small", "aria-label": word("card.stop", { slot }), title: word("card.stop", { slot }), onclick: () => askToStop(slot) },
    icon("aborted"));
}

/** The present direction and stillness of a slot. */
function showLive(slot) {
  const { node } = cardOf(slot.slot);
  const ball = node.querySelector(".ball");
  const of = live[slot.slot];
  if (!ball || !of) return;
  const label = word("pose.sphere", { slot: slot.slot, taken: of.taken.length, missing: of.missing.length });
  ball.replaceChildren(spherePicture({ ...of, next: slot.next?.vector }, label));
  const still = node.querySelector(".still");
  if (still) {
    still.hidden = false;
    fillStill(still, of);
  }
}

/** Verdicts are announced once, as they come. */
const announced = new Map();

function announce(now, before) {
  for (const slot of now.slots) {
    const verdict = VERDICTS[slot.state];
    const key = verdict ? `${slot.run}${slot.state}${slot.since}` : "";
    if (verdict && before && announced.get(slot.slot) !== key) {
      const said = `${word("card.slot")} ${slot.slot}: ${word(`verdict.${verdict}`)}. ${slot.code ? meaning(slot.code) : ""}`;
      at("verdicts").append(element("p", {}, said));
      while (at("verdicts").children.length > 8) at("verdicts").firstChild.remove();
    }
    announced.set(slot.slot, key);
  }
}

function showWork(now) {
  const given = { ...now.work, operator: operatorOf(now) };
  const shown = ["operator", "order", "part_number", "batch", "fixture", "reason"].filter((key) => given[key]);
  at("work").replaceChildren(...shown.map((key) => element("div", {}, element("dt", {}, word(`work.${key}`)), element("dd", {}, given[key]))));
}

// What people order.

let silent = false;
let request = null;
let queue = Promise.resolve();

/** One after the other, in the order in which they were scanned. */
function inTurn(work) {
  queue = queue.then(async () => {
    tell(at("taken"), word("command.sent"));
    try {
      tell(at("taken"), (await work()) ?? "");
      showError(null);
    } catch (e) {
      tell(at("taken"), "");
      if (!(e instanceof Refused)) throw e;
      if (e.code === "reason_missing") askForReason(e);
      else showError(e);
    }
  });
  return queue;
}

function showError(refused) {
  at("error").hidden = refused === null;
  if (refused === null) return;
  const { title, advice, detail } = explained(refused);
  tell(at("error-title"), title);
  tell(at("error-do"), advice);
  tell(at("error-detail"), detail === title ? "" : detail);
  if (refused.code === "not_signed_in") at("error-do").append(" ", element("a", { href: "/sign-in?next=/" }, word("page.sign_in")));
}

const PREFIXED = /^(OP|WO|SLOT|CMD):/i;
const TAKEN_FOR = { operator: "work.operator", order: "work.order", slot: "card.slot", serial: "card.serial" };

function take(text, kind = "") {
  text = text.trim();
  if (!text) return;
  inTurn(async () => {
    if (kind && !kind.endsWith(":")) {
      await ask("/api/1/tray", { method: "PUT", body: { [kind]: text } });
      return `${word("command.taken")}: ${word(`work.${kind}`)} ${text}`;
    }
    const scanned = PREFIXED.test(text) ? text : kind + text;
    const answer = await ask("/api/1/scan", { method: "POST", body: { text: scanned } });
    const name = TAKEN_FOR[answer.taken_for];
    const where = answer.taken_for === "serial" && answer.slot ? ` → ${answer.slot}` : "";
    return name ? `${word("command.taken")}: ${word(name)} ${answer[answer.taken_for] ?? text}${where}` : word("command.taken");
  });
}

// A repetition of the same request starts once, also if the answer was lost.
function start() {
  request ??= crypto.randomUUID();
  const sent = request;
  inTurn(async () => {
    try {
      await ask("/api/1/tray/start", { method: "POST", body: { request: sent } });
      request = null;
    } catch (e) {
      if (e.code !== "no_answer") request = null;
      throw e;
    }
    return word("command.taken");
  });
}

function askForReason({ message }) {
  const dialog = at("retest-dialog");
  at("retest-unit").textContent = message;
  const field = at("retest-reason");
  field.value = "";
  dialog.returnValue = "";
  dialog.onclose = () => {
    const reason = field.value.trim();
    if (dialog.returnValue !== "start" || !reason) return;
    inTurn(async () => void (await ask("/api/1/tray", { method: "PUT", body: { reason } })));
    start();
  };
  if (!dialog.open) dialog.showModal();
}

function askToStop(slot) {
  const dialog = at("stop-dialog");
  const field = at("stop-reason");
  field.value = "";
  dialog.returnValue = "";
  dialog.dataset.slot = slot ?? "";
  at("stop-title").textContent = slot === null ? word("command.stop_tray_title") : word("command.stop_slot_title", { slot });
  dialog.onclose = () => {
    if (dialog.returnValue !== "stop") return;
    const reason = field.value.trim();
    const path = slot === null ? "/api/1/tray/stop" : `/api/1/slots/${encodeURIComponent(slot)}/stop`;
    inTurn(async () => {
      await ask(path, { method: "POST", body: reason ? { reason } : {} });
      return word("command.taken");
    });
  };
  if (!dialog.open) dialog.showModal();
}

/** A question about a tray ends with it: its answer would be taken for the next one. */
function closeAnswered(now, before) {
  const other = before !== null && before.tray !== now.tray;
  const { slot } = at("stop-dialog").dataset;
  const working = now.slots.filter(atWork);
  if (other || !working.some((s) => !slot || s.slot === slot)) closed(at("stop-dialog"));
  if (other || working.length) closed(at("retest-dialog"));
}

function closed(dialog) {
  if (dialog.open) dialog.close("");
}

at("command").addEventListener("submit", (e) => {
  e.preventDefault();
  take(at("text").value, at("kind").value);
  at("text").value = "";
  at("kind").value = "";
});
at("start").addEventListener("click", start);
at("stop").addEventListener("click", () => askToStop(null));
at("clear").addEventListener("click", () =>
  inTurn(async () => {
    await ask("/api/1/tray/clear", { method: "POST" });
    return word("command.taken");
  }));
at("error-close").addEventListener("click", () => showError(null));
at("kind").addEventListener("change", () => at("text").focus());

function showButtons() {
  const slots = state?.slots ?? [];
  const working = slots.some(atWork);
  const again = slots.some((s) => s.state in VERDICTS) && !slots.some((s) => s.state === "scanned");
  at("start").disabled = silent || state === null || working || again;
  at("stop").disabled = silent || !working;
  at("clear").disabled = silent || working || (slots.every((s) => s.state === "empty") && !state?.chosen);
}

// A scanner types: fast, and Enter at the end. Keys go to the field from anywhere on
// the page. In another field, fast characters are taken for a scan, and taken out of
// it again. A dialog keeps what is typed, and only its buttons answer it: the Enter of
// a scanner, quick or slow, neither stops a tray nor takes a unit behind the dialog.

const FAST_MS = 60;
const SCAN_LEAST = 4;
let burst = "";
let last_ms = 0;
let last_target = null;

function typed(e) {
  if (e.ctrlKey || e.altKey || e.metaKey || e.isComposing) return;
  const fast = e.timeStamp - last_ms < FAST_MS;
  const field = e.target.matches?.("input, textarea") ? e.target : null;
  if (e.key === "Escape") showError(null);
  if (e.key === "Enter") {
    const scanned = fast && burst.length >= SCAN_LEAST && e.target === last_target ? burst : "";
    burst = "";
    if (document.querySelector("dialog[open]")) {
      if (field || scanned) e.preventDefault();
      return;
    }
    if (!scanned || field === at("text")) return;
    e.preventDefault();
    e.stopPropagation();
    if (field?.value.endsWith(scanned)) field.value = field.value.slice(0, -scanned.length);
    take(scanned);
    return;
  }
  if (e.key.length !== 1) return;
  burst = fast ? burst + e.key : e.key;
  last_ms = e.timeStamp;
  last_target = e.target;
  const used = field || document.querySelector("dialog[open]") || (e.key === " " && e.target.closest?.("button, a, summary, select"));
  if (!used) at("text").focus();
}

window.addEventListener("keydown", typed, true);

/** Loads the page anew if the station file was read again and has other slots; once for
 * the same slots. */
function loadIfChanged(now) {
  const slots = now.slots.map((s) => s.slot).join("\n");
  if (slots === page.slots.join("\n") || sessionStorage.getItem("loaded_for") === slots) return;
  sessionStorage.setItem("loaded_for", slots);
  location.reload();
}

new Following({
  shown(now) {
    loadIfChanged(now);
    const before = state;
    state = now;
    if (before?.tray !== now.tray) request = null;
    for (const slot of now.slots) if (!COLLECTING.includes(slot.stage)) delete live[slot.slot];
    closeAnswered(now, before);
    showWork(now);
    showCards(now);
    showTask(tasksOf(now));
    announce(now, before);
    showButtons();
  },
  live(slots) {
    live = slots;
    if (state === null) return;
    for (const slot of state.slots) if (atWork(slot)) showLive(slot);
    showStillOf(tasksOf(state)[0]);
  },
  silent(now, since) {
    silent = now;
    document.body.classList.toggle("stale", silent);
    at("stale").hidden = !silent;
    tell(at("stale-text"), silent ? word("stale.text", { time: since ? clockOf(since) : "–" }) : "");
    showButtons();
  },
});
