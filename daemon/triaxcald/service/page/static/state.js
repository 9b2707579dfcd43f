// The station's state as its event stream tells it: whole states, and events between
// them, as service/desk.py takes them.

import { ask, signIn } from "./common.js";

export const ENDED = { pass: "passed", fail: "failed", aborted: "aborted", not_judged: "not_judged" };
export const VERDICTS = Object.fromEntries(Object.entries(ENDED).map(([verdict, state]) => [state, verdict]));
export const atWork = (slot) => slot.state === "running" || slot.state === "lost";

/** The state after an event; the same one if the event is in it already. */
export function after(state, event) {
  if (state === null || event.seq <= state.seq) return state;
  const next = { ...state, seq: event.seq };
  if (event.event === "instruction") {
    const { label, face, vector, slots } = event;
    next.instruction = { label, face, vector, slots };
  } else if (event.event === "tray") {
    if (event.state === "ended") next.instruction = null;
  } else {
    next.slots = state.slots.map((slot) => (slot.slot === event.unit ? slotAfter(slot, event) : slot));
  }
  return next;
}

function slotAfter(slot, event) {
  switch (event.event) {
    case "stage":
      return { ...slot, stage: event.stage, found: 0, wanted: 0, next: null };
    case "poses":
      return { ...slot, found: event.found, wanted: event.wanted, next: event.next };
    case "lost":
      return { ...slot, state: "lost", code: event.code, reason: event.reason, since: event.time };
    case "back":
      return { ...slot, state: "running", code: null, reason: null, since: event.time };
    case "ended": {
      const { verdict, serial, run, code, reason } = event.outcome;
      return {
        ...slot, state: ENDED[verdict] ?? "aborted", serial: serial ?? slot.serial, run, code, reason,
        stage: null, next: null, since: event.time,
      };
    }
    default:
      return slot;
  }
}

const SILENT_MS = 4500;
const AGAIN_MS = 2000;

/** Follows the stream for good. `shown(state)` after each change, `live(slots)` with
 * present directions; `silent(true, since)` if there was no sign for `SILENT_MS`, with the
 * time of the last one, and `silent(false)` as soon as there is one again. */
export class Following {
  #source = null;
  #heard = null;
  #silent = false;
  #opened = 0;

  constructor({ shown, live, silent }) {
    Object.assign(this, { shown, live, silent, state: null });
    this.#open();
    setInterval(() => this.#look(), 500);
    for (const kind of ["visibilitychange", "pageshow", "online", "focus"]) {
      (kind === "visibilitychange" ? document : window).addEventListener(kind, () => this.#look());
    }
    window.addEventListener("pagehide", () => this.#source?.close());
  }

  #open() {
    this.#source?.close();
    this.#opened = performance.now();
    const source = new EventSource("/api/1/events?live=true");
    this.#source = source;
    const on = (kind, take) =>
      source.addEventListener(kind, (e) => {
        if (source !== this.#source) return;
        this.#sign();
        take(JSON.parse(e.data));
      });
    on("state", (state) => this.#set(state));
    on("event", (event) => this.#set(after(this.state, event)));
    on("live", ({ slots }) => this.live(slots));
    on("alive", () => {});
  }

  #set(state) {
    if (state === this.state) return;
    this.state = state;
    this.shown(state);
  }

  #sign() {
    this.#heard = performance.now();
    this.at = new Date().toISOString();
    if (this.#silent) {
      this.#silent = false;
      this.silent(false, null);
    }
  }

  // A browser holds timers of a hidden page back: also called when it is seen again.
  #look() {
    const now = performance.now();
    const since = this.#heard ?? this.#opened;
    if (now - Math.max(since, 0) < SILENT_MS && this.#source.readyState !== EventSource.CLOSED) return;
    if (now - since >= SILENT_MS && !this.#silent) {
      this.#silent = true;
      this.silent(true, this.at ?? null);
    }
    if (now - this.#opened < AGAIN_MS) return;
    if (this.#source.readyState === EventSource.CLOSED) this.#askWhy();
    this.#open();
  }

  // A refused stream does not tell why: the session may have ended.
  #askWhy() {
    ask("/api/1/station").catch((error) => error.code === "not_signed_in" && signIn());
  }
}
