// Sign-in: name and PIN give the cookie of a page.

import { ask, explained, page, Refused } from "./common.js";

const form = document.getElementById("sign-in");
const error = document.getElementById("error");

form.addEventListener("submit", async (e) => {
  e.preventDefault();
  const [name, pin] = [form.elements.name, form.elements.pin];
  const button = form.querySelector("button");
  button.disabled = true;
  error.hidden = true;
  try {
    const scanned = name.value.trim().replace(/^OP:/i, ""); // a badge
    await ask("/api/1/session", { method: "POST", body: { name: scanned, pin: pin.value } });
    location.assign(page.next);
  } catch (e) {
    if (!(e instanceof Refused)) throw e;
    const { title, advice, detail } = explained(e);
    error.textContent = e.code === "not_signed_in" ? detail || title : `${title} ${advice}`;
    error.hidden = false;
    pin.value = "";
    pin.focus();
  } finally {
    button.disabled = false;
  }
});

// Before this script is here, the form would go nowhere.
form.querySelector("button").disabled = false;
